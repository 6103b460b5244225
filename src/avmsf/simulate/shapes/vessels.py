"""Shapes that turn about an axis, by every angle or by a few."""

import math

import numpy as np
import torch

from avmsf.simulate.shapes.body import Body
from avmsf.simulate.shapes.shape import Draft, Symmetry, drawn_wall
from avmsf.simulate.shapes.turned import Profile, Turned, Warp

_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
_STEM_LAYERS = 16


def bowl(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bowl on a foot."""
    radius, depth = random.uniform(0.06, 0.1), random.uniform(0.55, 0.85)
    belly, bottom = random.uniform(0.8, 1.0), random.uniform(0.4, 0.52)
    wall = drawn_wall(random, 0.003, 0.0055, wall)
    height = depth * radius
    body = Body()
    corners = [(0.0, 0.0, 1.25), (bottom, 0.0, 1.25), (belly, 0.15, 1.0), (0.97, 0.7, 1.0), (1.0, 1.0, 0.9)]
    turned = Turned.lay(body, Profile.scaled(radius, height, wall, corners))
    _stand(body, turned, 0.42 * radius, random.uniform(0.004, 0.008))
    return Draft(body, wall, _round())


def plate(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a round dinner plate on a foot."""
    radius, rise = random.uniform(0.09, 0.14), random.uniform(0.012, 0.022)
    flat = random.uniform(0.55, 0.68)
    wall = drawn_wall(random, 0.0035, 0.0055, wall)
    body = Body()
    corners = [(0.0, 0.0, 1.0), (flat, 0.0, 1.0), (flat + 0.12, 0.65, 1.0), (flat + 0.2, 0.85, 1.0), (1.0, 1.0, 0.9)]
    turned = Turned.lay(body, Profile.scaled(radius, rise, wall, corners))
    _stand(body, turned, 0.8 * flat * radius, random.uniform(0.003, 0.005))
    return Draft(body, wall, _round())


def goblet(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a wine goblet: a cup and a foot, which a massive stem joins."""
    radius, depth = random.uniform(0.032, 0.045), random.uniform(1.9, 2.5)
    stem, foot = random.uniform(0.06, 0.085), random.uniform(0.85, 1.0)
    closing = random.uniform(0.75, 0.95)
    wall = drawn_wall(random, 0.002, 0.003, wall)
    height, around = depth * radius, max(0.0055, 1.2 * wall)
    body = Body()
    cup = Turned.lay(
        body,
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
    last = int(np.argmin(np.abs(np.hypot(*cup.sheet.middle[cup.rings.starts[:-1], :2].T) - around)))
    rings = cup.rings
    while rings.number > max(8, last + 4) and rings.starts[-1] > 260:
        rings = type(rings)(rings.counts[:-1], pole=True)
    base = Turned.lay(
        body,
        Profile([(0.0, 0.004, 1.8 * wall), (0.35 * radius, 0.004, 1.6 * wall), (foot * radius, 0.0, 1.2 * wall)]),
        rings=rings,
    )
    above, below = cup.middle_patch(last, lower=True), base.middle_patch(last, lower=False)
    start, end = cup.outside(above), base.top(below)
    part = np.linspace(0.0, 1.0, _STEM_LAYERS + 1)[1:-1, None, None]
    thinnest = random.uniform(0.0032, 0.0042) / around
    slim = 1.0 - (1.0 - thinnest) * np.sin(math.pi * part) ** 0.6
    layers = ((1.0 - part) * start + part * end) * np.concatenate([slim, slim, np.ones_like(slim)], axis=2)
    body.grow(above.triangles, above.order, cup.lower[above.rows], layers, end=base.upper[below.rows])
    return Draft(body, wall, _round())


def bell(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a hand bell with a massive grip on top."""
    radius, tall = random.uniform(0.045, 0.07), random.uniform(1.25, 1.6)
    waist, shoulder = random.uniform(0.5, 0.6), random.uniform(0.4, 0.5)
    grip, grip_radius = random.uniform(0.06, 0.08), random.uniform(0.007, 0.009)
    wall = drawn_wall(random, 0.003, 0.0045, wall)
    height = tall * radius
    body = Body()
    corners = [(0.0, 1.0, 1.2), (shoulder, 1.0, 1.2), (waist, 0.75, 1.0), (waist * 1.15, 0.3, 1.0), (1.0, 0.0, 1.5)]
    turned = Turned.lay(body, Profile.scaled(radius, height, wall, corners), points=800)
    distance = np.hypot(*turned.sheet.middle[turned.rings.starts[:-1], :2].T)
    patch = turned.middle_patch(max(1, int(np.argmin(np.abs(distance - grip_radius)))), lower=False)
    start = turned.top(patch)
    part = np.linspace(0.0, 1.0, 11)[1:, None]
    swell = 1.0 + 0.35 * np.sin(math.pi * part) ** 2 - 0.45 * np.clip(part - 0.8, 0.0, None) / 0.2
    rising = (1.0 - part) * start[:, 2] + part * (height + grip)
    layers = np.concatenate([swell[..., None] * start[None, :, :2], rising[..., None]], axis=2)
    body.grow(patch.triangles, patch.order, turned.upper[patch.rows], layers)
    return Draft(body, wall, _round())


def tube(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a chime: a tube that is open at both ends."""
    radius, length = random.uniform(0.012, 0.022), random.uniform(0.16, 0.26)
    wall = drawn_wall(random, 0.002, 0.003, wall)
    body = Body()
    # Outwards is upwards here, so that the lower side of the wall is the tube's outside.
    Turned.lay(body, Profile([(radius, height * length, wall) for height in (-0.5, 0.0, 0.5)]))
    return Draft(body, wall, Symmetry(_UP, None, _UP[None].clone()))


def pot(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a hexagonal pot."""
    radius, tall = random.uniform(0.05, 0.075), random.uniform(0.9, 1.3)
    flare, edged = random.uniform(1.0, 1.2), random.uniform(0.65, 0.9)
    wall = drawn_wall(random, 0.004, 0.006, wall)
    height, sides = tall * radius, 6
    body = Body()
    half = 0.5 * (1 + flare)
    corners = [(0.0, 0.0, 1.2), (0.93, 0.0, 1.2), (1.0, 0.1, 1.0), (half, 0.6, 1.0), (flare, 1.0, 1.0)]
    profile = Profile.scaled(radius, height, wall, corners)
    Turned.lay(body, profile, fold=sides, warp=_polygon(sides, edged))
    return Draft(body, wall, _turning(sides))


def fluted(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bowl with 5 to 8 lobes and a wavy rim."""
    radius, depth = random.uniform(0.065, 0.1), random.uniform(0.45, 0.65)
    lobes = int(random.integers(5, 9))
    deep, wavy = random.uniform(0.05, 0.08), random.uniform(0.03, 0.07)
    wall = drawn_wall(random, 0.003, 0.005, wall)
    height = depth * radius

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        wave = np.cos(lobes * angles) * np.clip((along - 0.25) / 0.75, 0.0, 1.0) ** 1.5
        return values[:, 0] * (1.0 + deep * wave), values[:, 1] + wavy * radius * wave

    body = Body()
    corners = [(0.0, 0.0, 1.2), (0.5, 0.0, 1.2), (0.85, 0.3, 1.0), (1.0, 1.0, 1.0)]
    Turned.lay(body, Profile.scaled(radius, height, wall, corners), fold=lobes, warp=warp)
    return Draft(body, wall, _turning(lobes))


def _stand(body: Body, turned: Turned, radius: float, height: float) -> None:
    """Put a wall that turns on a foot of about this radius."""
    distance = np.hypot(*turned.sheet.middle[turned.rings.starts[:-1], :2].T)
    counts = np.diff(turned.rings.starts)
    equal = np.flatnonzero(counts[1:-1] == counts[2:]) + 1
    ring = int(equal[np.argmin(np.abs(distance[equal] - radius))])
    below = turned.sheet.middle[:, 2] - turned.sheet.offsets[:, 2]
    turned.add_foot(body, ring, float(below.min()) - height)


def _polygon(sides: int, edged: float) -> Warp:
    """Return a warp that turns circles into polygons with corners at angle 0, fully beyond a third of the profile."""

    def warp(angles: np.ndarray, along: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part = 2.0 * math.pi / sides
        within = np.mod(angles, part) - 0.5 * part
        factor = math.cos(0.5 * part) / np.cos(within)
        weight = edged * np.clip(3.0 * along, 0.0, 1.0)
        return values[:, 0] * (1.0 + weight * (factor - 1.0)), values[:, 1]

    return warp


def _round() -> Symmetry:
    return Symmetry(_UP, None)


def _turning(order: int) -> Symmetry:
    angles = torch.arange(order, dtype=torch.float64) * (math.pi / order) + 0.5 * math.pi
    normals = torch.stack([torch.cos(angles), torch.sin(angles), torch.zeros_like(angles)], dim=1)
    return Symmetry(_UP, order, normals)
