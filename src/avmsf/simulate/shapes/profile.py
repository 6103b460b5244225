"""The half of a cross-section that turns about an axis, and the rings of points that it is covered with."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from avmsf.simulate.shapes.rings import Rings

POINTS = 900
"""Points in the middle of a wall: about 12 nodes of second order each, so some 32,000 degrees of freedom."""
_FINE = 2000
_LEAST, _MOST = 8, 34
"""Points of the innermost ring."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The middle of a wall as a smooth curve from the axis, or the lower end of a tube, outwards to the rim."""

    controls: Sequence[tuple[float, float, float]]
    """Radius, height and thickness, meters; the curve starts at the first, ends at the last and rounds those between.
    At the axis the first two have one height, so that the curve crosses it level."""

    @cached_property
    def _curve(self) -> tuple[Float64[np.ndarray, " fine"], Float64[np.ndarray, "fine 3"]]:
        """Places along the curve, 0 to 1 of its length, and radius, height and thickness there."""
        controls = np.array(self.controls, dtype=np.float64)
        inner = np.linspace(0.0, 1.0, len(controls) - 1)[1:-1]
        knots = np.concatenate([np.zeros(3), inner, np.ones(3)])
        values = BSpline(knots, controls, 2)(np.linspace(0.0, 1.0, _FINE))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(values[:, :2], axis=0), axis=1))])
        return length / length[-1], values

    @cached_property
    def length(self) -> float:
        """Meters along the curve."""
        return float(np.linalg.norm(np.diff(self._curve[1][:, :2], axis=0), axis=1).sum())

    def at(self, along: Float64[np.ndarray, " places"]) -> Float64[np.ndarray, "places 3"]:
        """Return radius, height and thickness at parts of the curve's length, 0 to 1."""
        places, values = self._curve
        return np.stack([np.interp(along, places, values[:, axis]) for axis in range(3)], axis=1)

    def rings(self, *, fold: int = 1, points: int = POINTS) -> Rings:
        """Return about `points` points on rings evenly along the curve, with triangles as equilateral as they may be.

        Rings of less than half and a quarter of the largest radius have as many times fewer points. The innermost
        has a multiple of 2 `fold` points, so that the triangles are carried onto themselves by `fold` turns.
        """
        radius = self.at(np.linspace(0.0, 1.0, 200))[:, 0]
        around = 2.0 * np.pi * radius.mean()
        best: tuple[float, Rings] | None = None
        for base in range(_LEAST + -_LEAST % (2 * fold), max(_MOST, 2 * fold) + 1, 2 * fold):
            for number in itertools.count(max(4, points // (4 * base))):
                rings = self._rings(base, number)
                if rings.starts[-1] < points:
                    continue
                mean = rings.starts[-1] / rings.number
                uneven = abs(np.log(self.length / (rings.number - 1) * mean / around))
                if best is None or uneven < best[0]:
                    best = (uneven, rings)
                break
        assert best is not None
        return best[1]

    def _rings(self, base: int, number: int) -> Rings:
        """Return rings at even distances, of which the innermost has `base` points."""
        radius = self.at(np.linspace(0.0, 1.0, number))[:, 0]
        closed = self.controls[0][0] == 0.0
        if not closed:
            return Rings((4 * base,) * number, pole=False)
        wanted = np.where(radius < 0.25 * radius.max(), 1, np.where(radius < 0.5 * radius.max(), 2, 4))
        counts = [1]
        for each in wanted[2:]:
            counts.append(min(max(counts[-1], int(each)), 2 * counts[-1]))
        return Rings(tuple(base * each for each in counts), pole=True)
