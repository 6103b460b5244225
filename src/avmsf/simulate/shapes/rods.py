"""Rods that leave a patch of a wall and run along a curve, into another patch or to an end of their own."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

_MELT = 0.16
"""Part of a rod's length over which the patch's outline melts into the rod's own."""


@dataclass(frozen=True, eq=False)
class Rod:
    """A rod in the plane y = 0, of oval cross-section."""

    curve: Float64[np.ndarray, "layers 2"]
    """Its middle, x and z, from the patch it leaves, meters."""
    widths: Float64[np.ndarray, " layers"]
    """Along y, meters."""
    heights: Float64[np.ndarray, " layers"]
    """Across y, meters."""

    def layers(
        self,
        start: Float64[np.ndarray, "columns 3"],
        across: Float64[np.ndarray, "columns 2"],
        end: Float64[np.ndarray, "columns 3"] | None = None,
    ) -> Float64[np.ndarray, "layers columns 3"]:
        """Return where columns of points pass, without the patches at the start and at the end.

        `across` says where each column lies in the cross-section, -1 to 1 along y and across it, in the square that the
        oval is made of.
        """
        tangents = np.gradient(self.curve, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
        one, other = across.T
        disc = np.stack([one * np.sqrt(1 - 0.5 * other**2), other * np.sqrt(1 - 0.5 * one**2)], axis=1)
        # Along the tangent, along y, and across both.
        oval = np.stack(
            [
                np.zeros((len(self.curve), len(across))),
                0.5 * self.widths[:, None] * disc[:, 0],
                0.5 * self.heights[:, None] * disc[:, 1],
            ],
            axis=-1,
        )
        part = np.linspace(0.0, 1.0, len(self.curve))
        leaving = _fade(part)[:, None, None]
        local = leaving * self._local(start, 0, tangents, normals)
        rest = 1.0 - leaving
        if end is not None:
            arriving = _fade(1.0 - part)[:, None, None]
            local = local + arriving * self._local(end, -1, tangents, normals)
            rest = rest - arriving
        local = local + rest * oval
        flat = local[..., :1] * tangents[:, None] + local[..., 2:] * normals[:, None] + self.curve[:, None]
        places = np.stack([flat[..., 0], local[..., 1], flat[..., 1]], axis=-1)
        return places[1:] if end is None else places[1:-1]

    def _local(self, places: np.ndarray, layer: int, tangents: np.ndarray, normals: np.ndarray) -> np.ndarray:
        flat = places[:, [0, 2]] - self.curve[layer]
        return np.stack([flat @ tangents[layer], places[:, 1], flat @ normals[layer]], axis=1)


def square_columns(rows: int, half: int) -> Float64[np.ndarray, "columns 2"]:
    """Return the places in a rod's cross-section of a patch of `rows` rings and 2 half + 1 points on each."""
    one, other = np.meshgrid(np.linspace(-1, 1, 2 * half + 1), np.linspace(-1, 1, rows))
    return np.stack([one.ravel(), other.ravel()], axis=1)


def smooth_curve(controls: list[tuple[float, float]], layers: int) -> Float64[np.ndarray, "layers 2"]:
    """Return points evenly along the curve that starts and ends as a polygon does and rounds it between."""
    polygon = np.array(controls, dtype=np.float64)
    knots = np.concatenate([np.zeros(4), np.linspace(0, 1, len(polygon) - 2)[1:-1], np.ones(4)])
    fine = BSpline(knots, polygon, 3)(np.linspace(0, 1, 1000))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    even = np.linspace(0, length[-1], layers)
    return np.stack([np.interp(even, length, fine[:, axis]) for axis in range(2)], axis=1)


def _fade(part: np.ndarray) -> np.ndarray:
    """Return 1 at 0, falling smoothly to 0 at `_MELT`."""
    rest = np.clip(1.0 - part / _MELT, 0.0, 1.0)
    return rest**2 * (3.0 - 2.0 * rest)
