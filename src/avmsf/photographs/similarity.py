"""From one frame and scale to another, by points that are known in both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import CaptureError
from avmsf.photographs.cameras import View


@dataclass(frozen=True, eq=False)
class Similarity:
    """A change of frame: a point x lies at `scale` * `rotation` x + `translation` in the new one."""

    scale: float
    """Lengths in the new frame for one in the old; above 0."""
    rotation: Float[Tensor, "3 3"]
    """Proper: no mirror; float64."""
    translation: Float[Tensor, " 3"]
    """In the new frame's unit; float64."""

    def apply(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Return where points of the old frame lie in the new one, float64."""
        return self.scale * points.double() @ self.rotation.T + self.translation


def align_similarity(source: Float[Tensor, "points 3"], target: Float[Tensor, "points 3"]) -> Similarity:
    """Return the similarity that brings the source points nearest to the target points, row by row.

    Least squares in closed form (Umeyama 1991, "Least-squares estimation of transformation parameters between two
    point patterns"). Raises CaptureError for fewer than three pairs, for points on one line, which do not determine the
    rotation, and for numbers that are not finite.
    """
    if source.shape != target.shape or len(source) < 3:
        raise CaptureError(
            f"expected the same 3 or more points in both frames, got {len(source)} and {len(target)}",
            name="points",
            value=[len(source), len(target)],
        )
    source, target = source.double(), target.double()
    for name, points in (("source", source), ("target", target)):
        if not bool(torch.isfinite(points).all()):
            raise CaptureError(f"{name}: expected points with finite coordinates", name=name)
        spread = torch.linalg.svdvals(points - points.mean(0))
        if float(spread[1]) < 1e-6 * max(float(spread[0]), 1e-300):
            raise CaptureError(
                f"{name}: expected points that span a triangle, got {len(points)} on one line or at one position",
                name=name,
                value=len(points),
            )
    old, new = source - source.mean(0), target - target.mean(0)
    left, stretch, right = torch.linalg.svd(new.T @ old)
    # Flat or noisy points fit a mirrored copy as well; of the two, only the rotation is wanted.
    signs = torch.ones(3, dtype=torch.float64)
    signs[2] = torch.sign(torch.linalg.det(left @ right))
    rotation = left @ torch.diag(signs) @ right
    scale = float((stretch * signs).sum() / old.square().sum())
    return Similarity(scale, rotation, target.mean(0) - scale * rotation @ source.mean(0))


def move_views(views: Sequence[View], similarity: Similarity) -> tuple[View, ...]:
    """Return the views with their cameras in the similarity's new frame; the pictures stay what they are."""
    moved = []
    for view in views:
        pose = view.camera.world_to_camera.double().clone()
        pose[:3, :3] = pose[:3, :3] @ similarity.rotation.T
        pose[:3, 3] = similarity.scale * pose[:3, 3] - pose[:3, :3] @ similarity.translation
        moved.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return tuple(moved)
