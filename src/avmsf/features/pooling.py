"""Features that obey an object's symmetries: each point takes the mean over its counterparts (paper, supplement)."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.mesh.neighborhoods import read_neighborhoods
from avmsf.symmetry.symmetries import Symmetries

DEFAULT_ANGLES = 36
"""Angles of an orbit about a continuous axis: every 10 degrees."""
DEFAULT_REACH_SPACINGS = 3.0
"""Distance in point spacings up to which the nearest point is a counterpart."""

SymmetricPoints = tuple[Int[Tensor, "members points"], Bool[Tensor, "members points"]]
"""Of every member of an orbit and every point: which row its counterpart is, and whether there is one."""


def refine(
    features: FeatureField,
    symmetries: Symmetries,
    *,
    iterations: int = 3,
    angles: int = DEFAULT_ANGLES,
    reach: float = DEFAULT_REACH_SPACINGS,
) -> FeatureField:
    """Return the same points with features that agree between symmetric places.

    In each of the `iterations` (paper: T, not stated), for each rotation the mean over its orbit of the feature of the
    point nearest to the rotated point (the point itself included), and then for each mirror plane the mean of a point's
    own feature and that of the point nearest to its image. An orbit has the turns of the rotation's order, or `angles`
    even ones about a continuous axis.

    A rotated point without a point of the cloud within `reach` spacings, in a hole of it, is left out of the mean, so
    that features of another part are not mixed in; `reach` 0 takes the nearest point however far it is (paper). Without
    symmetries the features come back as they are. Raises SceneError for fewer than one iteration or angle.
    """
    if iterations < 1 or angles < 1:
        name, value = ("iterations", iterations) if iterations < 1 else ("angles", angles)
        raise SceneError.expected("at least 1", value, name=name)
    orbits = _orbits(features.points, symmetries, angles=angles, reach=reach)
    pools = [_pool(rows, found) for rows, found in orbits]
    values = features.features.detach().cpu().numpy()
    for _ in range(iterations):
        for pool in pools:
            values = pool @ values
    return FeatureField(features.points, torch.from_numpy(values).to(features.features), features.encoder)


def orbit_spread(features: FeatureField, symmetries: Symmetries, *, angles: int = DEFAULT_ANGLES) -> float:
    """Return how much features differ between symmetric places, relative to how much they differ over the object.

    The square root of the mean variance over a point's counterparts, itself included, divided by the variance over all
    points: 0 where counterparts have the same feature, about 1 where they have no more in common than any two points.
    Points in whose orbit nothing else was seen do not count. Raises SceneError without symmetries.
    """
    if not symmetries:
        raise SceneError.expected("at least one", 0, name="symmetries")
    values = features.features.detach().cpu().double()
    total = float(values.var(dim=0, correction=0).sum())
    within, counted = 0.0, 0
    for rows, found in _orbits(features.points, symmetries, angles=angles):
        members = found.sum(dim=0)
        shared = members > 1
        mean = torch.from_numpy(_pool(rows, found).astype(np.float64) @ values.numpy())
        squares = sum(
            ((values[row] - mean).square().sum(dim=1) * there for row, there in zip(rows, found, strict=True)),
            start=torch.zeros_like(mean[:, 0]),
        )
        within += float((squares[shared] / (members[shared] - 1)).sum())
        counted += int(shared.sum())
    return (within / counted / total) ** 0.5 if counted and total > 0.0 else 0.0


def _pool(rows: Int[Tensor, "members points"], found: Bool[Tensor, "members points"]) -> csr_array:
    """Return the matrix that takes features to their means over the members that were found, the point among them."""
    count = rows.shape[1]
    shares = (found / found.sum(dim=0)).numpy()
    own = np.broadcast_to(np.arange(count), rows.shape)
    there = found.numpy()
    return csr_array((shares[there].astype(np.float32), (own[there], rows.numpy()[there])), shape=(count, count))


def _orbits(
    points: Float[Tensor, "points 3"], symmetries: Symmetries, *, angles: int, reach: float = DEFAULT_REACH_SPACINGS
) -> list[SymmetricPoints]:
    """Return the counterparts under every rotation, and then under every mirror plane."""
    if not symmetries:
        return []
    places = points.detach().double().cpu()
    tree = cKDTree(places.numpy())
    spacing = torch.from_numpy(read_neighborhoods(places.numpy()).spacing)
    limit = reach * spacing if reach else torch.full_like(spacing, math.inf)
    moved = [[each.turn(places, angle) for angle in each.angles(angles)[1:]] for each in symmetries.rotations]
    moved += [[mirror.reflect(places)] for mirror in symmetries.mirrors]
    return [_symmetric_points(each, tree, limit) for each in moved]


def _symmetric_points(
    moved: list[Float[Tensor, "points 3"]], tree: cKDTree, reach: Float[Tensor, " points"]
) -> SymmetricPoints:
    itself = torch.arange(len(reach))
    rows, found = [itself], [torch.ones_like(itself, dtype=torch.bool)]
    for places in moved:
        distance, row = (torch.from_numpy(part) for part in tree.query(places.numpy()))
        rows.append(row.long())
        found.append(distance <= reach[row])
    return torch.stack(rows), torch.stack(found)
