"""A lump that chance alone drew: no turn and no mirror carries it onto itself."""

import itertools

import numpy as np
import torch

from avmsf.fem.solid import Solid
from avmsf.simulate.shapes.body import Draft, Patch, SolidBuilder, drawn_wall

_CORE, _SHELLS = (10, 5, 3), 3
"""Boxes along each side of a blob's core, and layers around it."""
_LUMPS = 7


def blob(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a massive, lumpy, longish blob; its smallest extent is the wall."""
    length = random.uniform(0.2, 0.28)
    slim, flat = random.uniform(0.35, 0.45), drawn_wall(random, 0.045, 0.06, wall)
    centers = random.normal(size=(_LUMPS, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    heights = random.uniform(0.2, 0.4, _LUMPS) * np.where(np.arange(_LUMPS) % 3 == 2, -1.0, 1.0)
    widths = random.uniform(0.4, 0.65, _LUMPS)

    def shaped(ball: np.ndarray) -> np.ndarray:
        far = np.linalg.norm(ball, axis=1)
        units = ball / np.maximum(far, 1e-12)[:, None]
        apart = np.linalg.norm(units[:, None] - centers, axis=-1)
        # What is further from the middle stays further, as long as no dent takes more than 1 from the logarithm.
        return ball * np.exp(far * (np.exp(-((apart / widths) ** 2)) @ heights))[:, None]

    lattice, cells = _boxes(_CORE)
    # Equal angles instead of equal lengths, and half-way from a cube to a ball.
    angled = np.tan(lattice * np.pi / 4)
    far = np.linalg.norm(angled, axis=1)
    round_ = angled * (np.abs(angled).max(axis=1) / np.maximum(far, 1e-12))[:, None]
    core = 0.22 * angled + 0.26 * round_
    outside = Solid(torch.from_numpy(lattice), torch.from_numpy(cells)).boundary.numpy()
    rows, triangles = np.unique(outside, return_inverse=True)
    part = np.linspace(0.0, 1.0, _SHELLS + 1)[1:, None, None]
    balls = (1.0 - part) * core[rows] + part * (angled / np.maximum(far, 1e-12)[:, None])[rows]
    extents = np.ptp(shaped(balls[-1]), axis=0)
    scale = np.array([length, slim * length, flat]) / extents
    body = SolidBuilder()
    placed = body.place(shaped(core) * scale)
    body.fill(placed[cells])
    layers = np.stack([shaped(ball) * scale for ball in balls])
    Patch(body, placed[rows], layers[0], triangles.reshape(-1, 3), np.arange(len(rows))).grow(layers)
    return Draft(body, flat)


def _boxes(numbers: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a lattice of points from -1 to 1 and the tetrahedra, six a box, that fill it."""
    index = np.stack(np.meshgrid(*[np.arange(each + 1) for each in numbers], indexing="ij"), axis=-1).reshape(-1, 3)
    steps = np.array([(numbers[1] + 1) * (numbers[2] + 1), numbers[2] + 1, 1])
    first = (index[(index < numbers).all(axis=1)] * steps).sum(axis=1)
    cells = []
    for way in itertools.permutations(range(3)):
        # From one corner along three edges to the opposite one, in each order of the axes.
        corners = first[:, None] + np.concatenate([[0], np.cumsum(steps[list(way)])])
        odd = np.linalg.det(np.eye(3)[list(way)]) < 0
        cells.append(corners[:, [0, 2, 1, 3]] if odd else corners)
    return 2.0 * index / numbers - 1.0, np.concatenate(cells)
