"""Where cameras stand: poses checked, mended where that is safe, and judged together."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.location import Location
from avmsf.errors import Remark
from avmsf.photographs.cameras import Camera

# Poses written with four digits and rotations that drifted by rounding pass; shears and scales do not.
TOLERANCE = 1e-3


def rigid(matrix: Float[np.ndarray, "rows columns"], where: Location) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Return a camera-to-world matrix made exactly rigid, and the scale that its rotation had.

    `matrix` is 4 x 4, or 3 x 4 without the last row. A scale that is the same along all axes does not move the camera
    and is removed; the caller warns of it. Raises CaptureError, at `where`, for anything else that is not a rotation
    with a position.
    """
    key = "transform_matrix"
    if matrix.shape not in ((4, 4), (3, 4)):
        raise where.error(
            f"expected a pose of 4 x 4 numbers, got {matrix.shape[0]} x {matrix.shape[1]}",
            name=key,
            value=list(matrix.shape),
        )
    if not np.isfinite(matrix).all():
        value = float(matrix[~np.isfinite(matrix)][0])
        raise where.error(f"expected a finite pose, got {value}; estimate this camera again", name=key, value=value)
    if matrix.shape[0] == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise where.error(
            f"expected 0 0 0 1 as the pose's last row, got {matrix[3].tolist()}; perhaps the matrix is transposed",
            name=key,
            value=matrix[3].tolist(),
        )
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant < -1e-12:
        raise where.error(
            f"expected a pose with right-handed axes, got determinant {determinant:.3g}. transforms.json has OpenGL's "
            "axes: x right, y up, z backward. With y up and z forward (Unity, DirectX), negate the third column; with "
            "x right, y down and z forward (OpenCV), negate the second and the third",
            name=key,
            value=determinant,
        )
    left, stretches, right = np.linalg.svd(matrix[:3, :3])
    scale = float(stretches.mean())
    if scale < 1e-9 or np.abs(stretches / scale - 1).max() > TOLERANCE:
        raise where.error(
            f"expected a rotation in the pose, got a matrix with the scales "
            f"{', '.join(f'{stretch:.4g}' for stretch in stretches)} along its axes; remove the scales",
            name=key,
            value=stretches.tolist(),
        )
    mended = np.eye(4)
    mended[:3, :3], mended[:3, 3] = left @ right, matrix[:3, 3]
    return mended, scale


def opencv_from_opengl(camera_to_world: Float[np.ndarray, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return world to camera with OpenCV's axes from a rigid camera-to-world matrix with OpenGL's."""
    turned = camera_to_world * np.array([1.0, -1.0, -1.0, 1.0])
    inverse = np.eye(4)
    inverse[:3, :3] = turned[:3, :3].T
    inverse[:3, 3] = -turned[:3, :3].T @ turned[:3, 3]
    return torch.from_numpy(inverse)


def judge_cameras(cameras: Sequence[Camera]) -> list[Remark]:
    """Return remarks on the positions and axes of the cameras together."""
    positions = np.array([camera.position.tolist() for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3].tolist() for camera in cameras])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    if spread <= 1e-6 * float(np.linalg.norm(positions, axis=1).max()) + 1e-12:
        position = np.round(positions[0], 6).tolist()
        message = f"expected cameras at several positions, got all {len(cameras)} at {position}; check the camera file"
        return [Remark(message, name="positions", value=position)]
    center = _common_point(positions, axes)
    if center is None:
        return []
    behind = int((np.einsum("ij,ij->i", axes, center - positions) < 0).sum())
    if behind <= len(cameras) / 2:
        return []
    message = (
        f"{behind} of {len(cameras)} cameras point away from the point where their axes meet, "
        f"{np.round(center, 4).tolist()}: the axes are probably OpenCV's where OpenGL's are expected or the other way "
        "round, or the poses are inverted"
    )
    return [Remark(message, name="axes", value=behind)]


def _common_point(
    positions: Float[np.ndarray, "cameras 3"], axes: Float[np.ndarray, "cameras 3"]
) -> Float[np.ndarray, " 3"] | None:
    """Return the point nearest to all lines of sight by least squares; None where these are parallel."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-4 * len(axes):
        return None
    return np.linalg.solve(total, np.einsum("ijk,ik->j", across, positions))
