"""Where Gaussians start: points on or near the object, with colors, each a small soft ball."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import ZEROTH, GaussianCloud
from avmsf.photographs.cameras import View


@dataclass(frozen=True, eq=False)
class StartPoints:
    """Points to start Gaussians at: of structure from motion, of a surface, of a visual hull."""

    points: Float[Tensor, "points 3"]
    """Meters."""
    colors: Float[Tensor, "points 3"]
    """Red, green, blue, 0 to 1."""
    normals: Float[Tensor, "points 3"] | None = None
    """Unit normals to the surface, where they are known."""

    def __post_init__(self) -> None:
        if len(self.points) < 4 or not all(bool(torch.isfinite(each).all()) for each in (self.points, self.colors)):
            advice = "give others, or masks for a visual hull"
            raise SceneError.expected(
                "4 or more finite ones on the object", len(self.points), name="points", advice=advice
            )


def starting_cloud(
    start: StartPoints, *, degree: int, scale: float, opacity: float, flatness: float = 1.0
) -> GaussianCloud:
    """Return one Gaussian a point, `scale` mean distances to its 3 nearest neighbors wide (3DGS, section 5.1).

    Round, or where normals are known a disc across the normal, `flatness` times as thick as wide. Where points
    coincide, the width is a thousandth of their bounding box's diagonal at least. Raises SceneError where all do.
    """
    count = len(start.points)
    places = start.points.double().numpy()
    nearest = cKDTree(places).query(places, k=4)[0][:, 1:].mean(1)
    least = 1e-3 * float(np.linalg.norm(np.ptp(places, axis=0)))
    if not least > 0.0:
        raise SceneError.expected("points on the object", count, got=f"{count} at one position", name="points")
    scales = torch.from_numpy(np.log(np.maximum(scale * nearest, least))).float()[:, None].repeat(1, 3)
    harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
    harmonics[:, 0] = (start.colors - 0.5) / ZEROTH
    if start.normals is None:
        rotations = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    else:
        rotations = _rotations_to(start.normals.float())
        scales[:, 2] += math.log(flatness)
    logits = torch.full((count,), math.log(opacity / (1.0 - opacity)))
    return GaussianCloud(start.points.float().clone(), rotations, scales, logits, harmonics)


def _rotations_to(normals: Float[Tensor, "points 3"]) -> Float[Tensor, "points 4"]:
    """Return quaternions of the shortest rotations that take the z axis to the normals."""
    x, y, z = normals.unbind(1)
    # From z to -z every way is equally short: about the x axis.
    opposite = z < -1.0 + 1e-6
    quaternions = torch.stack([1.0 + z, -y, x, torch.zeros_like(x)], dim=1)
    quaternions[opposite] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(quaternions, dim=1)


def photographed_colors(
    points: Float[Tensor, "points 3"], views: Sequence[View], *, spacing: float
) -> Float[Tensor, "points 3"]:
    """Return the middle (median) of each point's colors in the views that see it, gray where none does.

    The points hide one another as balls of `spacing`, meters, would; what lies less than two of these behind the
    foremost is seen as well. Where they stand out from the object, some views show what is beside it: hence no mean.
    """
    shown = np.full((len(views), len(points), 3), np.nan, dtype=np.float32)
    for row, view in enumerate(views):
        places, depths = view.camera.project(points)
        # One cell of the depth map is as wide as a ball, so that the balls of a surface leave no gap.
        cell = max(1.0, spacing * view.camera.focal[0] / max(float(depths.median()), 1e-9))
        inside = view.camera.contains(places)
        place, depth = places[inside].numpy(), depths[inside].numpy()
        cells = (place / cell).astype(np.int64)
        foremost = np.full((int(view.camera.height / cell) + 1, int(view.camera.width / cell) + 1), np.inf)
        np.minimum.at(foremost, (cells[:, 1], cells[:, 0]), depth)
        seen = depth <= foremost[cells[:, 1], cells[:, 0]] + 2 * spacing
        pixels = place[seen].astype(np.int64)
        chosen = np.flatnonzero(inside.numpy())[seen]
        shown[row, chosen] = view.image.numpy()[pixels[:, 1], pixels[:, 0]] / 255.0
    colors = np.full((len(points), 3), 0.5, dtype=np.float32)
    known = np.isfinite(shown[:, :, 0]).any(0)
    colors[known] = np.nanmedian(shown[:, known], axis=0)
    return torch.from_numpy(colors)
