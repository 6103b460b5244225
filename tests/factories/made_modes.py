"""Elastic modes known in closed form, for tests that need no finite elements."""

import math

import numpy as np
import torch
import trimesh

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import CERAMIC


def with_middles(vertices: np.ndarray, faces: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Return nodes at corners and edge middles, and the six rows of each triangle."""
    pairs = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, rows = np.unique(pairs, axis=0, return_inverse=True)
    nodes = np.concatenate([vertices, vertices[edges].mean(axis=1)])
    triangles = np.concatenate([faces, len(vertices) + rows.reshape(-1, 3)], axis=1)
    return torch.from_numpy(nodes), torch.from_numpy(triangles)


def breathing_sphere(radius: float, frequency: float) -> ElasticModes:
    """Return a ball of one mode, in which its surface moves straight outwards by 1 / sqrt(kg) everywhere."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    nodes, triangles = with_middles(np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces))
    outward = nodes / nodes.norm(dim=1, keepdim=True)
    return ElasticModes(
        torch.tensor([frequency], dtype=torch.float64), nodes, triangles, outward[:, None], CERAMIC, 1.0
    )


def sliding_plate(
    frequency: tuple[float, ...] = (400.0, 830.0, 1310.0, 1330.0, 2270.0, 3900.0),
    *,
    sides: tuple[float, float, float] = (0.24, 0.17, 0.004),
) -> ElasticModes:
    """Return a plate whose modes are products of cosines along its sides, as between guides, and of any frequency."""
    box = trimesh.creation.box(sides)
    for _ in range(4):
        box = box.subdivide()
    nodes, triangles = with_middles(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces))
    mass = CERAMIC.density * math.prod(sides)
    numbers = [(1, 1), (2, 1), (1, 2), (3, 1), (2, 2), (4, 1), (1, 3), (3, 2)][: len(frequency)]
    shapes = torch.zeros(len(nodes), len(frequency), 3, dtype=torch.float64)
    for mode, (across, along) in enumerate(numbers):
        turns = [math.pi * number * (nodes[:, axis] / sides[axis] + 0.5) for axis, number in ((0, across), (1, along))]
        shapes[:, mode, 2] = 2.0 / math.sqrt(mass) * torch.cos(turns[0]) * torch.cos(turns[1])
    return ElasticModes(torch.tensor(frequency, dtype=torch.float64), nodes, triangles, shapes, CERAMIC, mass)
