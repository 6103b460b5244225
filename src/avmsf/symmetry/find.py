"""Finding the symmetries of a cloud: candidates, refined, tested, and completed by one another."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf.errors import SceneError
from avmsf.gaussians.neighborhoods import NEIGHBORS
from avmsf.symmetry.alignment import SymmetryTest, draw_by_area, read_surface
from avmsf.symmetry.candidates import candidates
from avmsf.symmetry.group import SymmetryGroup
from avmsf.symmetry.motion import Motion
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries

LIMIT = 8000
"""Most points of a cloud that are used."""
_MIN_POINTS = 10 * NEIGHBORS


def find_symmetries(
    points: Float[Tensor, "points 3"],
    *,
    seed: Seed = None,
    limit: int = LIMIT,
) -> Symmetries:
    """Return the rotations and mirror planes that carry a cloud of an object's surface onto itself.

    The cloud may be noisy, cover the object unevenly, and lie in any pose. At most `limit` points are used, drawn so
    that dense parts lose most. Candidates come from the principal axes, from pairs of points with similar surfaces
    around them, and from compositions of symmetries already found; each is refined to its best fit.

    **The error.** One half of the points is moved onto the surface that the other half samples. The error is the
    root mean square of their distances from it, without what the distances are when nothing is moved (noise), in
    spacings of that half; a spacing below 1 or above 1.6 % of the object's diagonal counts as that. A distance counts
    up to 3 spacings. So the tolerance of .38 lets the whole surface be off by that many spacings, or
    (.38 / 3)^2 = 1.6 % of it have no counterpart at all. The tolerance is less where the points are few or noisy: its
    square loses two standard errors of the noise. Where nothing of it is left, often below 600 points, no symmetry can
    be told from chance, and none is returned.

    An object that is damaged, or of which large parts are in no view, has only the symmetries of what is there.
    Compositions of two symmetries may have 1.15 times the error.

    Orders 2 to 12 are distinguished; an axis is continuous if every angle holds and no order holds better than the
    angles between its turns. Planes that contain a continuous axis and half turns across it follow from it and are not
    listed; of a ball, two of its axes are. Raises SceneError for points that are too few (240), not finite, or on one
    line.
    """
    if limit < _MIN_POINTS:
        raise SceneError.expected(f"at least {_MIN_POINTS} points", limit, name="limit")
    random = np.random.default_rng(int(torch.randint(2**31 - 1, (1,), generator=generator_of(seed))))
    places, middle, diagonal = _normalized(points)
    if len(places) > limit:
        places = places[draw_by_area(read_surface(places), limit, random, max_ratio=9.0)]
    surface = read_surface(places)
    test = SymmetryTest(places, random)
    group = SymmetryGroup(test)
    if test.tolerance > 0.0:
        for motion in candidates(surface, test.queries, random):
            group.consider(motion)
        group.drop_crowded_mirrors()
        group.complete()

    def vectors(motion: Motion) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
        point, direction = middle + diagonal * motion.centered().point, motion.direction
        # Of two opposite vectors the one whose largest number is positive.
        return torch.from_numpy(direction * np.sign(direction[np.argmax(np.abs(direction))])), torch.from_numpy(point)

    turns = sorted(group.turns, key=lambda each: (not each.continuous, -(each.order or 0), each.error))
    mirrors = sorted(group.mirrors, key=lambda each: each.error)
    return Symmetries(
        tuple(RotationalSymmetry(*vectors(each), each.order, each.error) for each in turns),
        tuple(MirrorSymmetry(*vectors(each), each.error) for each in mirrors),
        test.spacing * diagonal,
        test.tolerance,
        # Of what was tried and failed, only what is no symmetry after all; some failed before what implies them was
        # found.
        min((each.error for each in group.rejected if not group.knows(each)), default=math.inf),
    )


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
