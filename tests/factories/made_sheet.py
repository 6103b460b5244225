"""Open sheets over a rectangle, and a bent tile as a painted mesh: the smallest object to simulate."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh

from avmsf.mesh.surface import Surface


def sheet_over(
    x: np.ndarray, y: np.ndarray, height: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda x, y: 0.0 * x
) -> Surface:
    """Return two triangles a square between lines at `x` and `y`, meters, that face upwards."""
    across, along = np.meshgrid(x, y, indexing="ij")
    rows = np.arange(across.size).reshape(across.shape)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = np.stack([across, along, height(across, along)], axis=-1).reshape(-1, 3)
    return Surface(torch.from_numpy(points).float(), torch.from_numpy(faces))


def tile(path: Path, *, bend: float = 1.0) -> Path:
    """Write a bent tile in four colors, open below; without a bend it is flat."""
    sheet = sheet_over(
        np.linspace(-0.1, 0.1, 13), np.linspace(-0.07, 0.07, 9), lambda x, y: bend * (0.6 * x**2 + 0.3 * x * y)
    )
    places = sheet.vertices.double().numpy()
    colors = np.array([[200, 40, 30], [30, 90, 200], [240, 220, 60], [70, 160, 80]], dtype=np.uint8)
    painted = colors[(places[:, 0] > 0) + 2 * (places[:, 1] > 0)]
    mesh = trimesh.Trimesh(places, sheet.faces.numpy(), vertex_colors=painted, process=False)
    path.write_bytes(mesh.export(file_type="ply"))
    return path
