"""A dense mesh simplified before anything slow is done with it: by quadrics, within a tolerance of its thickness."""

import math
from collections.abc import Callable

import fast_simplification
import numpy as np

from avmsf.fem.mesh_smoothing import ROUGH, averaged, roughness
from avmsf.fem.skin import Skin
from avmsf.mesh.closest_point import ClosestPoints

MOST = 60_000
"""Triangles beyond which a mesh is simplified even where that changes its form."""
ENOUGH = 16_000
"""Triangles beyond which it is simplified as far as its form stays: finite-element models have some thousand on their
surface."""
_TOLERANCE = 0.01
"""Root mean square distance of the simplified mesh from the given one, over the mean thickness, twice the volume over
the area. Frequencies of a thin wall go with its thickness. Chosen on a twisted blade."""
_ROUNDS = 4
"""Averages taken of a noisy mesh over the thinning, so that they reach little farther than an edge that stays."""


def thinned(skin: Skin, *, log: Callable[[str], None]) -> Skin:
    """Return a skin of at most `MOST` triangles, fewer within the tolerance, and tell what was done to a larger one.

    More are left where fewer would open a seam or share an edge among three.
    """
    count = len(skin.faces)
    if count <= ENOUGH:
        return skin
    log(f"checking a mesh of {count} triangles")
    rough = roughness(skin)
    # Quadrics follow each noisy corner, and tie the skin into knots.
    even = averaged(skin, math.ceil(_ROUNDS * count / MOST)) if rough >= ROUGH else skin
    tolerance, places = _TOLERANCE * 2.0 * abs(even.volume) / float(even.areas.sum()), even.spread()
    for most in (ENOUGH, 2 * ENOUGH, MOST):
        found = simplified(even, most, like=skin)
        distances = ClosestPoints(found.points[found.faces])(places).distances
        if float(np.sqrt((distances**2).mean())) <= tolerance:
            break
    if found is even:
        return skin
    noise = "" if even is skin else f", after smoothing its noise of {rough:.0f} degrees"
    log(f"mesh simplified to {len(found.faces)} triangles{noise}")
    return found


def simplified(skin: Skin, count: int, *, like: Skin | None = None, most: float = math.inf) -> Skin:
    """Return a skin of about `count` triangles by quadrics, its volume about the same; as it is if it has no more.

    More, up to `most`, are left where fewer would open a seam or share an edge among three, compared with the skin that
    it is `like`. Where more than `most` would be, it has about `count` that share some.
    """
    reference = skin if like is None else like
    opened, crowded, count = reference.open_edges, reference.crowded_edges, max(count, 4)
    knotted = None
    while count < len(skin.faces):
        points, faces = fast_simplification.simplify(skin.points, skin.faces, target_count=count)
        found = Skin.compact(points.astype(np.float64), faces.astype(np.int64))
        if len(found.faces) >= 4 and found.open_edges <= opened and found.crowded_edges <= crowded:
            return found
        knotted = found if knotted is None and found.open_edges <= opened else knotted
        count *= 2
        if knotted is not None and min(count, len(skin.faces)) > most:
            return knotted
    return skin
