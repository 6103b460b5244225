"""Where cameras stand: poses checked, mended where that is safe, and judged together."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.cameras import Camera
from avmsf.errors import CaptureError

# Poses written with four digits and rotations that drifted by rounding pass; shears and scales do not.
TOLERANCE = 1e-3


def rigid(matrix: Float[np.ndarray, "rows columns"], where: str) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Return a camera-to-world matrix made exactly rigid, and the scale that its rotation had.

    `matrix` is 4 x 4, or 3 x 4 without the last row. A scale that is the same along all axes does not move the camera
    and is taken out; the caller warns of it. Raises CaptureError, which names `where`, for anything else that is not
    a rotation with a position.
    """
    if matrix.shape not in ((4, 4), (3, 4)):
        raise CaptureError(f"{where}: expected a pose of 4 x 4 numbers, found {matrix.shape[0]} x {matrix.shape[1]}")
    if not np.isfinite(matrix).all():
        raise CaptureError(f"{where}: the pose holds numbers that are not finite: estimate this camera again")
    if matrix.shape[0] == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise CaptureError(
            f"{where}: expected 0 0 0 1 as the pose's last row, found {matrix[3].tolist()}: perhaps the matrix is "
            "transposed"
        )
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant < -1e-12:
        raise CaptureError(
            f"{where}: the pose's axes are left-handed (determinant {determinant:.3g}, expected 1). transforms.json "
            "has OpenGL's axes: x right, y up, z backward. With y up and z forward (Unity, DirectX), negate the third "
            "column; with x right, y down and z forward (OpenCV), negate the second and the third, not one alone"
        )
    left, stretches, right = np.linalg.svd(matrix[:3, :3])
    scale = float(stretches.mean())
    if scale < 1e-9 or np.abs(stretches / scale - 1).max() > TOLERANCE:
        raise CaptureError(
            f"{where}: expected a rotation in the pose, found a matrix that stretches by "
            f"{', '.join(f'{stretch:.4g}' for stretch in stretches)} along its axes: write a rotation alone"
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


def judge_cameras(cameras: Sequence[Camera]) -> list[str]:
    """Return what looks wrong about how the cameras stand to each other, one sentence each."""
    positions = np.array([camera.position.tolist() for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3].tolist() for camera in cameras])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    if spread <= 1e-6 * float(np.linalg.norm(positions, axis=1).max()) + 1e-12:
        place = np.round(positions[0], 6).tolist()
        return [
            f"all {len(cameras)} cameras stand in one place, {place}: a shape shows only from several places; check "
            "the positions in the camera file"
        ]
    center = _common_point(positions, axes)
    if center is None:
        return []
    behind = int((np.einsum("ij,ij->i", axes, center - positions) < 0).sum())
    if behind <= len(cameras) / 2:
        return []
    return [
        f"{behind} of {len(cameras)} cameras look away from the point where their axes meet, "
        f"{np.round(center, 4).tolist()}: the camera's axes are probably OpenCV's where OpenGL's are expected or the "
        "other way round, or the poses are inverted"
    ]


def _common_point(
    positions: Float[np.ndarray, "cameras 3"], axes: Float[np.ndarray, "cameras 3"]
) -> Float[np.ndarray, " 3"] | None:
    """Return the point nearest to all lines of sight by least squares; None where these are parallel."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-4 * len(axes):
        return None
    return np.linalg.solve(total, np.einsum("ijk,ik->j", across, positions))
