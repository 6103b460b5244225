"""The symmetries of a cloud of points as planes and axes in its own frame."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf.errors import SceneError
from avmsf.mesh.neighborhoods import NEIGHBORS
from avmsf.symmetry.alignment import SymmetryTest, draw_by_area, local_planes
from avmsf.symmetry.candidates import candidates
from avmsf.symmetry.motions import Vector
from avmsf.symmetry.search import find_group
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries

MAX_POINTS = 8000
"""Points of a cloud that are used, at most."""
_MIN_POINTS = 10 * NEIGHBORS


def find_symmetries(points: Float[Tensor, "points 3"], *, seed: Seed = None) -> Symmetries:
    """Return the rotations and mirror planes that carry a cloud of an object's surface onto itself.

    The cloud may be noisy, cover the object unevenly, and lie in any pose. At most `MAX_POINTS` points are used, drawn
    so that dense parts lose most. What is returned is one point group, the largest that holds: candidates come from the
    principal axes and from pairs of points with similar surfaces around them, and those that hold generate groups.

    **The error.** Each quarter of the points is moved onto the surface that the others sample. The error is the root
    mean square of their distances from it, without what the distances are when nothing is moved (noise), in spacings of
    three quarters; a spacing below 1 or above 1.6 % of the object's diagonal counts as that. A distance counts up to 3
    spacings. So the tolerance of .38 lets the whole surface be off by that many spacings, or (.38 / 3)^2 = 1.6 % of it
    have no counterpart at all. It holds for the mean over a group; each motion may have 1.15 times the error. Where the
    points are so few or noisy that chance changes squared errors by more than the tolerance, or where they fill a
    volume and show no surface, no symmetry is returned.

    An object that is damaged, or of which large parts are in no view, has only the symmetries of what is there.

    Orders 2 to 12 are distinguished; an axis is continuous if every angle holds and no order holds better than the
    angles between its turns. Planes that contain a continuous axis and half turns across it follow from it and are not
    listed; of a ball, two of its axes are. Raises SceneError for points that are too few (240), not finite, or on one
    line.
    """
    random = np.random.default_rng(int(torch.randint(2**31 - 1, (1,), generator=generator_of(seed))))
    places, middle, diagonal = _normalized(points)
    if len(places) > MAX_POINTS:
        places = places[draw_by_area(local_planes(places), MAX_POINTS, random, max_ratio=9.0)]
    test = SymmetryTest(places, random)
    group, rejected = None, [math.inf]
    if test.tolerance > 0.0:
        group, outside = find_group(test, candidates(test.surface, test.queries, random))
        rejected += outside

    turns: list[RotationalSymmetry] = []
    mirrors: list[MirrorSymmetry] = []
    if group is not None:
        center = group.motions.center()
        for axis, order, rows in group.axes():
            foot = torch.from_numpy(middle + diagonal * (center - (center @ axis) * axis))
            turns.append(RotationalSymmetry(_signed(axis), foot, order, _root(group.squares[rows].mean())))
        for normal, row in group.planes():
            foot = torch.from_numpy(middle + diagonal * (center @ normal) * normal)
            mirrors.append(MirrorSymmetry(_signed(normal), foot, _root(group.squares[row])))
    turns.sort(key=lambda each: (not each.continuous, -(each.order or 0), each.error))
    mirrors.sort(key=lambda each: each.error)
    return Symmetries(tuple(turns), tuple(mirrors), test.spacing * diagonal, test.tolerance, _root(min(rejected)))


def _root(square: float) -> float:
    """Return an error from its square, which chance makes negative for a symmetry as often as positive."""
    return math.sqrt(max(square, 0.0))


def _signed(direction: Vector) -> Float[Tensor, " 3"]:
    """Return the one of two opposite vectors whose largest number is positive."""
    return torch.from_numpy(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def _normalized(
    points: Float[Tensor, "points 3"],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " 3"], float]:
    """Return the points about their middle in units of their diagonal, and both."""
    if len(points) < _MIN_POINTS:
        wanted = f"at least {_MIN_POINTS} points of a surface to find symmetries"
        advice = "draw more points from it, or reconstruct with more Gaussians"
        raise SceneError.expected(wanted, len(points), name="points", advice=advice)
    wrong = torch.nonzero(~torch.isfinite(points).all(dim=1)).flatten()
    if len(wrong):
        row = int(wrong[0])
        raise SceneError.expected("finite coordinates", points[row].tolist(), row=row, name="points")
    places = points.detach().double().cpu().numpy()
    middle = places.mean(axis=0)
    _, extent, axes = np.linalg.svd(places - middle, full_matrices=False)
    if extent[1] < 1e-3 * extent[0] or extent[0] == 0.0:
        wanted = "points all over an object's surface, not on one line or at one position"
        got = f"{len(points)} with an extent of {extent[0]:.3g}, {extent[1]:.3g} and {extent[2]:.3g} m"
        raise SceneError.expected(wanted, extent.tolist(), got=got, name="points")
    # A box along the principal axes: the diagonal must not depend on how the object lies.
    diagonal = float(np.linalg.norm(np.ptp((places - middle) @ axes.T, axis=0)))
    return (places - middle) / diagonal, middle, diagonal
