"""Walls that turn about an axis, exactly or with lobes and corners, and what is fixed to them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from avmsf.simulate.shapes.body import Body
from avmsf.simulate.shapes.profile import POINTS, Profile
from avmsf.simulate.shapes.rings import Patch, Rings
from avmsf.simulate.shapes.sheet import Sheet

Warp = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From angles, parts of the profile's length and [points, 2] radii and heights to new radii and heights."""


@dataclass(frozen=True, eq=False)
class Turned:
    """A wall that turns about the z axis, and its sides in a body."""

    rings: Rings
    sheet: Sheet
    lower: Int[np.ndarray, " points"]
    """Rows in the body: below where the profile runs outwards, outside where it rises."""
    upper: Int[np.ndarray, " points"]

    @classmethod
    def lay(
        cls,
        body: Body,
        profile: Profile,
        *,
        fold: int = 1,
        points: int = POINTS,
        crowd: float = 0.0,
        warp: Warp | None = None,
        rings: Rings | None = None,
    ) -> "Turned":
        """Add the wall that a profile describes to a body.

        `crowd` moves points around the axis towards angle 0, where they come to lie 1 - crowd as far apart.
        `rings` are chosen for the profile where they are not given.
        """
        rings = profile.rings(fold=fold, points=points) if rings is None else rings
        along = rings.ring / (rings.number - 1)
        values = profile.at(along)
        angles = 2.0 * np.pi * rings.turns
        angles = angles - crowd * np.sin(angles)
        radius, height = values[:, 0], values[:, 1]
        if warp is not None:
            radius, height = warp(angles, along, values[:, :2])
        middle = np.stack([radius * np.cos(angles), radius * np.sin(angles), height], axis=1)
        sheet = Sheet.of(middle, values[:, 2], rings.triangles, rings.order)
        return cls(rings, sheet, *body.lay(sheet))

    def side_patch(self, rings: range, half: int, *, falling: bool = False) -> Patch:
        """Return the outside of these rings within `half` points of angle 0, ring by ring, from below or from above."""
        places = np.arange(-half, half + 1)
        rows = np.concatenate([self.rings.rows(ring, places) for ring in (reversed(rings) if falling else rings)])
        return Patch.of(self.sheet.triangles, self.sheet.order, rows, lower=True)

    def middle_patch(self, last: int, *, lower: bool) -> Patch:
        """Return the rings about the pole up to one."""
        return Patch.of(self.sheet.triangles, self.sheet.order, np.arange(self.rings.starts[last + 1]), lower=lower)

    def outside(self, patch: Patch) -> Float64[np.ndarray, "columns 3"]:
        """Return where a patch's points lie on the lower side, meters."""
        return self.sheet.middle[patch.rows] - self.sheet.offsets[patch.rows]

    def top(self, patch: Patch) -> Float64[np.ndarray, "columns 3"]:
        """Return where a patch's points lie on the upper side, meters."""
        return self.sheet.middle[patch.rows] + self.sheet.offsets[patch.rows]

    def add_foot(self, body: Body, ring: int, bottom: float) -> None:
        """Add a foot under the band between a ring and the next one, down to a height."""
        rows = np.concatenate([np.arange(self.rings.starts[ring], self.rings.starts[ring + 2])])
        patch = Patch.of(self.sheet.triangles, self.sheet.order, rows, lower=True)
        places = self.outside(patch)
        places[:, 2] = bottom
        body.grow(patch.triangles, patch.order, self.lower[patch.rows], places[None])
