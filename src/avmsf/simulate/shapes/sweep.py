"""Rods swept along a curve, and vessels with such a handle, which tells one side from the others."""

import math

import numpy as np
from jaxtyping import Float64

from avmsf.simulate.shapes.body import Draft, Patch, drawn_wall
from avmsf.simulate.shapes.revolution import Profile, Turned, spline

_MELT_RATIO = 0.16
"""Part of a rod's length over which the patch's outline melts into the rod's own."""
_CROWDING = 0.35
_HALF_WIDTH = 2
"""Points on each side of the middle of a handle's patch."""
_BANDS = 2
"""Bands of triangles that a handle's patch is high."""
_HANDLE_LAYERS = 26


def swept(
    curve: Float64[np.ndarray, "layers 2"],
    widths: Float64[np.ndarray, " layers"],
    heights: Float64[np.ndarray, " layers"],
    start: Float64[np.ndarray, "columns 3"],
    end: Float64[np.ndarray, "columns 3"] | None = None,
) -> Float64[np.ndarray, "inner columns 3"]:
    """Return where the columns of a patch of `_BANDS` pass that grows to a rod, without the patches at both ends.

    The rod lies in the plane y = 0: `curve` is its middle, x and z, from the patch it leaves; its cross-section is an
    oval, `widths` along y and `heights` across it, meters.
    """
    tangents = np.gradient(curve, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    # In the square that the oval is made of, -1 to 1 along y and across it.
    one, other = map(np.ravel, np.meshgrid(np.linspace(-1, 1, 2 * _HALF_WIDTH + 1), np.linspace(-1, 1, _BANDS + 1)))
    disc = np.stack([one * np.sqrt(1 - 0.5 * other**2), other * np.sqrt(1 - 0.5 * one**2)], axis=1)
    # Along the tangent, along y, and across both.
    sizes = np.stack([np.zeros(len(curve)), 0.5 * widths, 0.5 * heights], axis=1)
    oval = sizes[:, None] * np.stack([np.zeros(len(disc)), *disc.T], axis=1)

    def local(places: np.ndarray, layer: int) -> np.ndarray:
        flat = places[:, [0, 2]] - curve[layer]
        return np.stack([flat @ tangents[layer], places[:, 1], flat @ normals[layer]], axis=1)

    part = np.linspace(0.0, 1.0, len(curve))[:, None, None]
    leaving = _fade(part)
    moved, rest = leaving * local(start, 0), 1.0 - leaving
    if end is not None:
        arriving = _fade(1.0 - part)
        moved, rest = moved + arriving * local(end, -1), rest - arriving
    moved = moved + rest * oval
    flat = moved[..., :1] * tangents[:, None] + moved[..., 2:] * normals[:, None] + curve[:, None]
    places = np.stack([flat[..., 0], moved[..., 1], flat[..., 1]], axis=-1)
    return places[1:] if end is None else places[1:-1]


def smooth_curve(controls: list[tuple[float, float]], layers: int) -> Float64[np.ndarray, "layers 2"]:
    """Return points evenly along the curve that starts and ends as a polygon does and rounds it between."""
    lengths, points = spline(controls, degree=3, count=1000)
    even = np.linspace(0, lengths[-1], layers)
    return np.stack([np.interp(even, lengths, axis) for axis in points.T], axis=1)


def _fade(part: np.ndarray) -> np.ndarray:
    """Return 1 at 0, falling smoothly to 0 at `_MELT_RATIO`."""
    rest = np.clip(1.0 - part / _MELT_RATIO, 0.0, 1.0)
    return rest**2 * (3.0 - 2.0 * rest)


def mug(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a mug with a handle."""
    radius, tall = random.uniform(0.036, 0.046), random.uniform(2.0, 2.6)
    narrow = random.uniform(0.85, 1.0)
    wall = drawn_wall(random, 0.0035, 0.005, wall)
    height = tall * radius
    corners = [(0.0, 0.0, 1.2), (0.9 * narrow, 0.0, 1.2), (narrow, 0.03, 1.0), (1.0, 0.45, 1.0), (1.0, 1.0, 0.9)]
    turned = Turned.lay(Profile.scaled(radius, height, wall, corners), points=800, crowd=_CROWDING)
    reach, low = random.uniform(0.75, 0.95) * radius, random.uniform(0.2, 0.3)
    _add_handle(turned, low * height, random.uniform(0.74, 0.82) * height, reach, random)
    return Draft(turned.body, wall)


def jug(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a jug that leans and pours to the side, a quarter turn or so from its handle: no symmetry."""
    radius, tall = random.uniform(0.04, 0.055), random.uniform(2.2, 2.8)
    neck, lip = random.uniform(0.6, 0.75), random.uniform(0.5, 0.65)
    aside, tilt = math.radians(random.uniform(75.0, 130.0)), random.uniform(0.2, 0.3)
    wall = drawn_wall(random, 0.0035, 0.005, wall)
    height = tall * radius

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        apart = np.angle(np.exp(1j * (angles - aside)))
        near = np.exp(-((apart / 0.5) ** 2)) - 0.25 * np.exp(-((apart / 1.0) ** 2))
        part = np.clip((along - 0.7) / 0.3, 0.0, 1.0) ** 2
        tilted = tilt * radius * np.cos(apart) * np.clip((along - 0.3) / 0.7, 0.0, 1.0) ** 2
        return values[:, 0] * (1.0 + lip * part * near) + tilted, values[:, 1] + 0.12 * radius * part * near

    corners = [(0.0, 0.0, 1.2), (0.75, 0.0, 1.2), (1.2, 0.3, 1.0), (neck, 0.75, 1.0), (1.1 * neck, 1.0, 1.0)]
    turned = Turned.lay(Profile.scaled(radius, height, wall, corners), points=800, crowd=_CROWDING, warp=warp)
    reach = random.uniform(0.9, 1.1) * radius
    _add_handle(turned, random.uniform(0.38, 0.45) * height, 0.82 * height, reach, random)
    return Draft(turned.body, wall)


def skillet(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a frying pan with a long handle."""
    radius, depth = random.uniform(0.07, 0.095), random.uniform(0.3, 0.42)
    length, rise = random.uniform(1.2, 1.6), random.uniform(0.15, 0.35)
    wall = drawn_wall(random, 0.003, 0.0045, wall)
    height = depth * radius
    corners = [(0.0, 0.0, 1.2), (0.8, 0.0, 1.2), (0.9, 0.15, 1.0), (1.0, 1.0, 1.0)]
    turned = Turned.lay(Profile.scaled(radius, height, wall, corners), points=760, crowd=_CROWDING)
    ring = _ring_at(turned, 0.6 * height)
    patch = _handle_patch(turned, ring)
    middle = patch.places.mean(axis=0)
    far = length * radius
    curve = smooth_curve(
        [
            (middle[0], middle[2]),
            (middle[0] + 0.15 * far, middle[2] + 0.05 * far * rise),
            (middle[0] + 0.5 * far, middle[2] + 0.5 * far * rise),
            (middle[0] + far, middle[2] + 0.9 * far * rise),
        ],
        _HANDLE_LAYERS,
    )
    part = np.linspace(0.0, 1.0, _HANDLE_LAYERS)
    rounding = np.sqrt(1.0 - 0.85 * np.clip((part - 0.88) / 0.12, 0.0, 1.0) ** 2)
    widths = random.uniform(0.018, 0.023) * (0.75 + 0.25 * part) * rounding
    heights = np.full(_HANDLE_LAYERS, random.uniform(0.009, 0.012)) * (0.4 + 0.6 * rounding)
    patch.grow(swept(curve, widths, heights, patch.places))
    return Draft(turned.body, wall)


def _add_handle(turned: Turned, low: float, high: float, reach: float, random: np.random.Generator) -> None:
    """Add an ear at angle 0 between two heights that stands out by `reach`, meters."""
    above, below = _ring_at(turned, high), _ring_at(turned, low)
    if (above + below + _BANDS) % 2:
        # The diagonals of the upper patch, upside down, are the lower one's only every second band.
        below += 1
    leaving, arriving = _handle_patch(turned, above), _handle_patch(turned, below, falling=True)
    (x, _, z), (x_end, _, z_end) = leaving.places.mean(axis=0), arriving.places.mean(axis=0)
    far = max(x, x_end) + reach
    curve = smooth_curve(
        [
            (x, z),
            (x + 0.45 * reach, z),
            (far, z + 0.02 * (z - z_end)),
            (far + 0.1 * reach, 0.6 * z + 0.4 * z_end),
            (far - 0.15 * reach, 0.8 * z_end + 0.2 * z),
            (x_end + 0.4 * reach, z_end),
            (x_end, z_end),
        ],
        _HANDLE_LAYERS,
    )
    part = np.linspace(0.0, 1.0, _HANDLE_LAYERS)
    widths = random.uniform(0.012, 0.015) * (1.0 - 0.15 * np.sin(math.pi * part))
    heights = np.full(_HANDLE_LAYERS, random.uniform(0.0075, 0.0095))
    leaving.grow(swept(curve, widths, heights, leaving.places, arriving.places), end=arriving)


def _handle_patch(turned: Turned, ring: int, *, falling: bool = False) -> Patch:
    """Return the outside about angle 0 from a ring on, ring by ring, from below or from above."""
    places, rings = np.arange(-_HALF_WIDTH, _HALF_WIDTH + 1), range(ring, ring + _BANDS + 1)
    rows = [turned.rings.rows(each, places) for each in (reversed(rings) if falling else rings)]
    return turned.lower.part(np.concatenate(rows))


def _ring_at(turned: Turned, height: float) -> int:
    """Return the lowest ring of a patch whose middle lies at a height on the wall."""
    heights = turned.middle[turned.rings.starts[:-1], 2]
    # Beyond the bottom, where heights rise.
    return int(np.argmin(np.abs(heights - height))) - _BANDS // 2
