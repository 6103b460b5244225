"""Surfaces of revolution with a wall, exactly or with lobes and corners: vessels, bells and tubes."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from avmsf.simulate.shapes.body import Draft, Patch, Rings, SolidBuilder, drawn_wall

DEFAULT_POINTS = 900
"""Points in the middle of a wall: about 12 nodes of second order each, so some 32,000 degrees of freedom."""
_CURVE_POINTS = 2000
_MIN_INNER, _MAX_INNER = 8, 34
"""Points of the innermost ring."""


def spline(
    controls: Sequence[tuple[float, ...]], *, degree: int, count: int
) -> tuple[Float64[np.ndarray, " count"], Float64[np.ndarray, "count axes"]]:
    """Return points on the curve that starts and ends as a polygon does and rounds it between, and the length there.

    Lengths are those along the first two coordinates.
    """
    polygon = np.array(controls, dtype=np.float64)
    inner = np.linspace(0.0, 1.0, len(polygon) - degree + 1)[1:-1]
    knots = np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])
    points = BSpline(knots, polygon, degree)(np.linspace(0.0, 1.0, count))
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))]), points


@dataclass(frozen=True, eq=False)
class Profile:
    """The middle of a wall as a smooth curve from the axis, or the lower end of a tube, outwards to the rim."""

    controls: Sequence[tuple[float, float, float]]
    """Radius, height and thickness, meters; the curve starts at the first, ends at the last and rounds those between.
    At the axis the first two have one height, so that the curve crosses it level."""

    @classmethod
    def scaled(
        cls, radius: float, height: float, wall: float, corners: Sequence[tuple[float, float, float]]
    ) -> "Profile":
        """Return the profile whose corners are multiples of a radius, a height and a wall."""
        return cls([(out * radius, up * height, thick * wall) for out, up, thick in corners])

    @cached_property
    def _curve(self) -> tuple[Float64[np.ndarray, " fine"], Float64[np.ndarray, "fine 3"]]:
        """Lengths along the curve, meters, and radius, height and thickness there."""
        return spline(self.controls, degree=2, count=_CURVE_POINTS)

    @property
    def length(self) -> float:
        """Meters along the curve."""
        return float(self._curve[0][-1])

    def at(self, along: Float64[np.ndarray, " places"]) -> Float64[np.ndarray, "places 3"]:
        """Return radius, height and thickness at parts of the curve's length, 0 to 1."""
        lengths, values = self._curve
        return np.stack([np.interp(along, lengths / self.length, each) for each in values.T], axis=1)

    def rings(self, *, fold: int = 1, points: int = DEFAULT_POINTS) -> Rings:
        """Return about `points` points on rings evenly along the curve, with triangles as equilateral as they may be.

        Rings of less than half and a quarter of the largest radius have as many times fewer points. The innermost
        has a multiple of 2 `fold` points, so that the triangles are carried onto themselves by `fold` turns.
        """
        radius = self.at(np.linspace(0.0, 1.0, 200))[:, 0]
        around = 2.0 * np.pi * radius.mean()

        def large_enough(base: int) -> Rings:
            numbers = itertools.count(max(4, points // (4 * base)))
            return next(
                rings for rings in (self._rings(base, number) for number in numbers) if len(rings.ring) >= points
            )

        def unevenness(rings: Rings) -> float:
            return float(abs(np.log(self.length / (rings.number - 1) * (len(rings.ring) / rings.number) / around)))

        bases = range(_MIN_INNER + -_MIN_INNER % (2 * fold), max(_MAX_INNER, 2 * fold) + 1, 2 * fold)
        return min(map(large_enough, bases), key=unevenness)

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


Warp = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From angles, parts of the profile's length and [points, 2] radii and heights to new radii and heights."""


@dataclass(frozen=True, eq=False)
class Turned:
    """A wall that turns about the z axis, and its sides in a body."""

    body: SolidBuilder
    rings: Rings
    middle: Float64[np.ndarray, "points 3"]
    """The rings' points in the middle of the wall, meters."""
    lower: Patch
    """The side that lies below where the profile runs outwards, outside where it rises."""
    upper: Patch

    @classmethod
    def lay(
        cls,
        profile: Profile,
        *,
        fold: int = 1,
        points: int = DEFAULT_POINTS,
        crowd: float = 0.0,
        warp: Warp | None = None,
        rings: Rings | None = None,
        body: SolidBuilder | None = None,
    ) -> "Turned":
        """Add the wall that a profile describes to a body, by default one of its own.

        `crowd` moves points around the axis towards angle 0, where they come to lie 1 - crowd as far apart.
        `rings` are chosen for the profile where they are not given.
        """
        body = SolidBuilder() if body is None else body
        rings = profile.rings(fold=fold, points=points) if rings is None else rings
        along = rings.ring / (rings.number - 1)
        values = profile.at(along)
        angles = 2.0 * np.pi * rings.turns
        angles = angles - crowd * np.sin(angles)
        radius, height = values[:, 0], values[:, 1]
        if warp is not None:
            radius, height = warp(angles, along, values[:, :2])
        middle = np.stack([radius * np.cos(angles), radius * np.sin(angles), height], axis=1)
        return cls(body, rings, middle, *body.lay(middle, values[:, 2], rings.triangles, rings.order))

    @property
    def radii(self) -> Float64[np.ndarray, " rings"]:
        """Distance of each ring's first point from the axis, meters."""
        return np.hypot(*self.middle[self.rings.starts[:-1], :2].T)

    def add_foot(self, radius: float, height: float) -> None:
        """Add a foot of about this radius and this height below the lowest point, under a band of two equal rings."""
        counts = np.diff(self.rings.starts)
        equal = np.flatnonzero(counts[1:-1] == counts[2:]) + 1
        ring = int(equal[np.argmin(np.abs(self.radii[equal] - radius))])
        patch = self.lower.part(np.arange(self.rings.starts[ring], self.rings.starts[ring + 2]))
        places = patch.places.copy()
        places[:, 2] = float(self.lower.places[:, 2].min()) - height
        patch.grow(places[None])


_STEM_LAYERS = 16


def bowl(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bowl on a foot."""
    radius, depth = random.uniform(0.06, 0.1), random.uniform(0.55, 0.85)
    belly, bottom = random.uniform(0.8, 1.0), random.uniform(0.4, 0.52)
    wall = drawn_wall(random, 0.003, 0.0055, wall)
    corners = [(0.0, 0.0, 1.25), (bottom, 0.0, 1.25), (belly, 0.15, 1.0), (0.97, 0.7, 1.0), (1.0, 1.0, 0.9)]
    turned = Turned.lay(Profile.scaled(radius, depth * radius, wall, corners))
    turned.add_foot(0.42 * radius, random.uniform(0.004, 0.008))
    return Draft(turned.body, wall)


def plate(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a round dinner plate on a foot."""
    radius, rise = random.uniform(0.09, 0.14), random.uniform(0.012, 0.022)
    flat = random.uniform(0.55, 0.68)
    wall = drawn_wall(random, 0.0035, 0.0055, wall)
    corners = [(0.0, 0.0, 1.0), (flat, 0.0, 1.0), (flat + 0.12, 0.65, 1.0), (flat + 0.2, 0.85, 1.0), (1.0, 1.0, 0.9)]
    turned = Turned.lay(Profile.scaled(radius, rise, wall, corners))
    turned.add_foot(0.8 * flat * radius, random.uniform(0.003, 0.005))
    return Draft(turned.body, wall)


def goblet(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a wine goblet: a cup and a foot, which a massive stem joins."""
    radius, depth = random.uniform(0.032, 0.045), random.uniform(1.9, 2.5)
    stem, foot = random.uniform(0.06, 0.085), random.uniform(0.85, 1.0)
    closing = random.uniform(0.75, 0.95)
    wall = drawn_wall(random, 0.002, 0.003, wall)
    height, around = depth * radius, max(0.0055, 1.2 * wall)
    cup = Turned.lay(
        Profile(
            [
                (0.0, stem, 1.6 * wall),
                (0.5 * radius, stem, 1.3 * wall),
                (1.15 * radius, stem + 0.25 * height, wall),
                (1.05 * radius, stem + 0.7 * height, wall),
                (closing * radius, stem + height, wall),
            ]
        ),
        points=620,
    )
    # The same disc of rings in the cup and in the foot, so that the stem's ends fit both.
    last = int(np.argmin(np.abs(cup.radii - around)))
    rings = cup.rings
    while rings.number > max(8, last + 4) and rings.starts[-1] > 260:
        rings = type(rings)(rings.counts[:-1], pole=True)
    sole = Profile([(0.0, 0.004, 1.8 * wall), (0.35 * radius, 0.004, 1.6 * wall), (foot * radius, 0.0, 1.2 * wall)])
    base = Turned.lay(sole, rings=rings, body=cup.body)
    disc = np.arange(rings.starts[last + 1])
    above, below = cup.lower.part(disc), base.upper.part(disc)
    start, end = above.places, below.places
    part = np.linspace(0.0, 1.0, _STEM_LAYERS + 1)[1:-1, None, None]
    thinnest = random.uniform(0.0032, 0.0042) / around
    slim = 1.0 - (1.0 - thinnest) * np.sin(math.pi * part) ** 0.6
    layers = ((1.0 - part) * start + part * end) * np.concatenate([slim, slim, np.ones_like(slim)], axis=2)
    above.grow(layers, end=below)
    return Draft(cup.body, wall)


def bell(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a hand bell with a massive grip on top."""
    radius, tall = random.uniform(0.045, 0.07), random.uniform(1.25, 1.6)
    waist, shoulder = random.uniform(0.5, 0.6), random.uniform(0.4, 0.5)
    grip, grip_radius = random.uniform(0.06, 0.08), random.uniform(0.007, 0.009)
    wall = drawn_wall(random, 0.003, 0.0045, wall)
    height = tall * radius
    corners = [(0.0, 1.0, 1.2), (shoulder, 1.0, 1.2), (waist, 0.75, 1.0), (waist * 1.15, 0.3, 1.0), (1.0, 0.0, 1.5)]
    turned = Turned.lay(Profile.scaled(radius, height, wall, corners), points=800)
    _crown(turned, grip_radius, height + grip, swell=0.35, taper=0.45)
    return Draft(turned.body, wall)


def bottle(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bottle with a narrow neck, through which hardly any view sees the inside."""
    radius, tall = random.uniform(0.032, 0.042), random.uniform(4.0, 5.0)
    neck, shoulder = random.uniform(0.32, 0.42), random.uniform(0.58, 0.68)
    wall = drawn_wall(random, 0.0025, 0.0035, wall)
    corners = [(0.0, 0.0, 1.4), (0.95, 0.0, 1.3), (1.0, 0.1, 1.0), (1.0, shoulder, 1.0)]
    corners += [(neck, shoulder + 0.12, 1.0), (neck, 1.0, 1.1)]
    return Draft(Turned.lay(Profile.scaled(radius, tall * radius, wall, corners)).body, wall)


def lid(random: np.random.Generator, wall: float | None) -> Draft:
    """Make the domed lid of a pot, with a massive knob."""
    radius, rise = random.uniform(0.07, 0.11), random.uniform(0.25, 0.35)
    knob, knob_radius = random.uniform(0.02, 0.028), random.uniform(0.009, 0.012)
    wall = drawn_wall(random, 0.003, 0.0045, wall)
    height = rise * radius
    corners = [(0.0, 1.0, 1.1), (0.45, 1.0, 1.0), (0.85, 0.45, 1.0), (0.93, 0.05, 1.1), (1.0, 0.0, 1.1)]
    turned = Turned.lay(Profile.scaled(radius, height, wall, corners))
    _crown(turned, knob_radius, height + knob, swell=0.7, taper=0.6)
    return Draft(turned.body, wall)


def tube(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a chime: a tube that is open at both ends."""
    radius, length = random.uniform(0.012, 0.022), random.uniform(0.16, 0.26)
    wall = drawn_wall(random, 0.002, 0.003, wall)
    # Outwards is upwards here, so that the lower side of the wall is the tube's outside.
    profile = Profile([(radius, height * length, wall) for height in (-0.5, 0.0, 0.5)])
    return Draft(Turned.lay(profile).body, wall)


def pot(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a hexagonal pot."""
    radius, tall = random.uniform(0.05, 0.075), random.uniform(0.9, 1.3)
    flare, edged = random.uniform(1.0, 1.2), random.uniform(0.65, 0.9)
    wall = drawn_wall(random, 0.004, 0.006, wall)
    half, sides = 0.5 * (1 + flare), 6
    corners = [(0.0, 0.0, 1.2), (0.93, 0.0, 1.2), (1.0, 0.1, 1.0), (half, 0.6, 1.0), (flare, 1.0, 1.0)]
    profile = Profile.scaled(radius, tall * radius, wall, corners)
    return Draft(Turned.lay(profile, fold=sides, warp=_polygon(sides, edged)).body, wall)


def fluted(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bowl with 5 to 8 lobes and a wavy rim."""
    radius, depth = random.uniform(0.065, 0.1), random.uniform(0.45, 0.65)
    lobes = int(random.integers(5, 9))
    deep, wavy = random.uniform(0.05, 0.08), random.uniform(0.03, 0.07)
    wall = drawn_wall(random, 0.003, 0.005, wall)

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wave = np.cos(lobes * angles) * np.clip((along - 0.25) / 0.75, 0.0, 1.0) ** 1.5
        return values[:, 0] * (1.0 + deep * wave), values[:, 1] + wavy * radius * wave

    corners = [(0.0, 0.0, 1.2), (0.5, 0.0, 1.2), (0.85, 0.3, 1.0), (1.0, 1.0, 1.0)]
    profile = Profile.scaled(radius, depth * radius, wall, corners)
    return Draft(Turned.lay(profile, fold=lobes, warp=warp).body, wall)


def dish(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a hand-shaped shallow dish."""
    radius, depth = random.uniform(0.07, 0.11), random.uniform(0.28, 0.42)
    waves = np.arange(1, 5)
    outline = random.normal(size=4) * (0.06, 0.11, 0.06, 0.03)
    rim = random.normal(size=4) * (0.03, 0.03, 0.04, 0.02)
    phases = random.uniform(0.0, 2.0 * np.pi, (2, 4))
    wall = drawn_wall(random, 0.0035, 0.0055, wall)

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turning = waves * angles[:, None]
        out = np.cos(turning + phases[0]) @ outline
        up = np.cos(turning + phases[1]) @ rim
        return values[:, 0] * (1.0 + out * along), values[:, 1] + radius * up * along**2

    corners = [(0.0, 0.0, 1.2), (0.55, 0.0, 1.2), (0.8, 0.25, 1.0), (1.0, 1.0, 0.9)]
    profile = Profile.scaled(radius, depth * radius, wall, corners)
    return Draft(Turned.lay(profile, warp=warp).body, wall)


def _crown(turned: Turned, radius: float, top: float, *, swell: float, taper: float) -> None:
    """Grow a massive grip of about this radius from the middle of a wall up to a height, meters."""
    last = max(1, int(np.argmin(np.abs(turned.radii - radius))))
    patch = turned.upper.part(np.arange(turned.rings.starts[last + 1]))
    start = patch.places
    part = np.linspace(0.0, 1.0, 11)[1:, None]
    wide = 1.0 + swell * np.sin(math.pi * part) ** 2 - taper * np.clip(part - 0.8, 0.0, None) / 0.2
    rising = (1.0 - part) * start[:, 2] + part * top
    layers = np.concatenate([wide[..., None] * start[None, :, :2], rising[..., None]], axis=2)
    patch.grow(layers)


def _polygon(sides: int, edged: float) -> Warp:
    """Return a warp that turns circles into polygons with corners at angle 0, fully beyond a third of the profile."""

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part = 2.0 * math.pi / sides
        within = np.mod(angles, part) - 0.5 * part
        factor = math.cos(0.5 * part) / np.cos(within)
        weight = edged * np.clip(3.0 * along, 0.0, 1.0)
        return values[:, 0] * (1.0 + weight * (factor - 1.0)), values[:, 1]

    return warp
