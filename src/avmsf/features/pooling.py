"""Features that obey an object's symmetries: each point takes the mean over its counterparts (paper, supplement)."""

import math

import numpy as np
import torch
from jaxtyping import Float
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
    means = [counts / counts.sum(axis=1)[:, None] for counts in orbits]
    values = features.features.detach().cpu().numpy()
    for _ in range(iterations):
        for mean in means:
            values = mean @ values
    return FeatureField(features.points, torch.from_numpy(values).to(features.features), features.encoder)


def orbit_spread(features: FeatureField, symmetries: Symmetries, *, angles: int = DEFAULT_ANGLES) -> float:
    """Return how much features differ between symmetric places, relative to how much they differ over the object.

    The square root of the mean variance over a point's counterparts, itself included, divided by the variance over all
    points: 0 where counterparts have the same feature, about 1 where they have no more in common than any two points.
    Points in whose orbit nothing else was seen do not count. Raises SceneError without symmetries.
    """
    if not symmetries:
        raise SceneError.expected("at least one", 0, name="symmetries")
    values = features.features.detach().cpu().double().numpy()
    total, within, counted = float(values.var(axis=0).sum()), 0.0, 0
    for counts in _orbits(features.points, symmetries, angles=angles):
        members = counts.sum(axis=1)
        shared = members > 1
        squares = (counts @ values**2 - (counts @ values) ** 2 / members[:, None]).sum(axis=1)
        within += float((squares[shared] / (members[shared] - 1)).sum())
        counted += int(shared.sum())
    # Rounding may leave less than nothing.
    return math.sqrt(max(within, 0.0) / counted / total) if counted and total > 0.0 else 0.0


def _orbits(
    points: Float[Tensor, "points 3"], symmetries: Symmetries, *, angles: int, reach: float = DEFAULT_REACH_SPACINGS
) -> list[csr_array]:
    """Return how often each point [rows] has each other [columns] as a counterpart, and itself once.

    Under every rotation, and then under every mirror plane.
    """
    if not symmetries:
        return []
    places = points.detach().double().cpu()
    tree, own = cKDTree(places.numpy()), np.arange(len(places))
    spacing = read_neighborhoods(places.numpy()).spacing
    limit = reach * spacing if reach else np.full_like(spacing, math.inf)
    moved = [[each.turn(places, angle) for angle in each.angles(angles)[1:]] for each in symmetries.rotations]
    moved += [[mirror.reflect(places)] for mirror in symmetries.mirrors]
    found = []
    for images in moved:
        pairs = [(own, own)]
        for image in images:
            distance, row = tree.query(image.numpy())
            there = distance <= limit[row]
            pairs.append((own[there], row[there]))
        rows, columns = np.concatenate(pairs, axis=1)
        found.append(csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(own), len(own))))
    return found
