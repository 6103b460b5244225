"""Open sheets over a rectangle."""

from collections.abc import Callable

import numpy as np
import torch

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
