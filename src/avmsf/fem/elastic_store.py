"""Elastic modes as tensors: in files of fields with shapes in float32, and to the last bit in files of a cache.

A file of a cache has the tensors of `ElasticModes`, those of its perturbations, and in its header one JSON:

{"mass": 0.31, "material": {"name": "ceramic", "density": 2700.0, "young": 7.2e10, ...}}
"""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avmsf._utils.caching import keep_if_possible
from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import read_tensors, write_tensors
from avmsf._utils.text import count_of, parse_json
from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import NOMINAL, Material
from avmsf.fem.perturbation import Perturbations

_KIND = FileKind("avmsf_elastic", "elastic modes", "compute them again", SimulationError)
_PERTURBATIONS = ("stiffness", "mass", "poisson")


def mode_sizes(modes: ElasticModes) -> dict[str, int]:
    """Return the sizes of the tensors."""
    return {"nodes": len(modes.nodes), "triangles": len(modes.triangles), "shapes": len(modes)}


def mode_tensors(modes: ElasticModes) -> dict[str, Tensor]:
    """Return the tensors by name, as files of fields hold them."""
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


def save_modes(modes: ElasticModes, path: Path) -> None:
    """Write modes to one file, which `load_modes` reads back to the last bit.

    A file that is there stays whole until the new one is. Raises SimulationError where it cannot be written.
    """
    tensors = mode_tensors(modes) | {"shapes": modes.shapes}
    if modes.perturbations is not None:
        tensors |= {name: torch.from_numpy(getattr(modes.perturbations, name)) for name in _PERTURBATIONS}
    header = json.dumps({"mass": modes.mass, "material": asdict(modes.material)}, allow_nan=False)
    write_tensors(path, tensors, header, _KIND)


def load_modes(path: Path) -> ElasticModes:
    """Read modes that `save_modes` wrote.

    Raises SimulationError for a file that is missing, cut short or of another kind.
    """
    header, tensors = read_tensors(path, _KIND)
    try:
        record = parse_json(header)
        changes = {name: tensors.pop(name).numpy() for name in _PERTURBATIONS if name in tensors}
        return ElasticModes(
            **tensors, material=Material(**record["material"]), mass=float(record["mass"]),
            perturbations=Perturbations(**changes) if changes else None,
        )  # fmt: skip
    except (ValueError, TypeError, KeyError) as error:
        raise _KIND.damaged(path, error, name="modes") from error


def modes_once(path: Path | None, compute: Callable[[], ElasticModes], *, log: Callable[[str], None]) -> ElasticModes:
    """Return the modes that `path` keeps, or compute them and keep them there, where that is possible; None keeps none.

    A damaged file is made again, and `log` is called. Raises as `compute`.
    """
    # Unlike Path.is_file, this is False where the folder cannot be read.
    if path is not None and os.path.isfile(path):
        try:
            return load_modes(path)
        except SimulationError as error:
            log(f"computing the modes again ({error})")
    modes = compute()
    if path is not None:
        keep_if_possible(lambda: save_modes(modes, path), path)
    return modes
