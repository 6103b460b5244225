"""The tensors of elastic modes on a body's surface, as files of fields hold them; shapes are kept in float32."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from avmsf._utils.records import count_of
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import NOMINAL


def mode_sizes(modes: ElasticModes) -> dict[str, int]:
    """Return the sizes of the tensors."""
    return {"nodes": len(modes.nodes), "triangles": len(modes.triangles), "shapes": len(modes)}


def mode_tensors(modes: ElasticModes) -> dict[str, Tensor]:
    """Return the tensors by name."""
    named = {name: getattr(modes, name) for name in ("frequency", "nodes", "triangles")}
    return named | {"shapes": modes.shapes.float()}


def mode_skeleton(sizes: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return tensors on the device `meta`, of the shapes and dtypes that belong to sizes.

    Raises ValueError, TypeError or KeyError for what are no sizes.
    """
    nodes, triangles, shapes = (count_of(sizes[name], name) for name in ("nodes", "triangles", "shapes"))
    return {
        "frequency": torch.empty(shapes, dtype=torch.float64, device="meta"),
        "nodes": torch.empty(nodes, 3, dtype=torch.float64, device="meta"),
        "triangles": torch.empty(triangles, 6, dtype=torch.int64, device="meta"),
        "shapes": torch.empty(nodes, shapes, 3, dtype=torch.float32, device="meta"),
    }


def restored_modes(tensors: Mapping[str, Tensor], prefix: str) -> ElasticModes:
    """Return the modes, of the nominal material and no mass, of tensors whose names begin with `prefix`.

    Raises ValueError for values that no modes have.
    """
    frequency, nodes, rows, shapes = (
        tensors[f"{prefix}{name}"] for name in ("frequency", "nodes", "triangles", "shapes")
    )
    if not bool((frequency > 0).all()):
        raise ValueError(f"expected {prefix}frequency above 0, got {float(frequency.min()):g}")
    if rows.numel() and not 0 <= int(rows.min()) <= int(rows.max()) < len(nodes):
        raise ValueError(
            f"expected corners of triangles from 0 to {len(nodes) - 1}, got {int(rows.min())} to {int(rows.max())}"
        )
    return ElasticModes(frequency, nodes, rows, shapes.double(), NOMINAL, mass=0.0)
