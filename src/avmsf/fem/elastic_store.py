"""Elastic modes as one file: safetensors with the tensors of `ElasticModes`, and one JSON in the header for the rest.

{"format": 2, "version": "0.1.0", "mass": 0.31,
 "sizes": {"modes": 64, "nodes": 9000, "triangles": 4400, "fields": null},
 "material": {"name": "ceramic", "density": 2700.0, "young": 7.2e10, "poisson": 0.19, "alpha": 6.0, "beta": 1e-7}}
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import torch
from safetensors.torch import save as to_bytes
from torch import Tensor

from avmsf._utils.caching import keep_if_possible
from avmsf._utils.files import write_whole
from avmsf._utils.state import read_tensors
from avmsf._utils.text_files import parse_json
from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import Material
from avmsf.fem.perturbation import Perturbations

FORMAT = 2
"""Number of this format; it grows with every change that older versions could not read."""
_KEY = "avmsf_elastic"
_PERTURBATIONS = ("stiffness", "mass", "poisson")


def save_modes(modes: ElasticModes, path: str | Path) -> None:
    """Write modes to one file, which `load_modes` reads back to the last bit.

    A file that is there stays whole until the new one is. Raises SimulationError where it cannot be written.
    """
    path = Path(path)
    tensors = {
        "frequency": modes.frequency,
        "nodes": modes.nodes,
        "triangles": modes.triangles,
        "shapes": modes.shapes,
    }
    if modes.perturbations is not None:
        tensors |= {name: torch.from_numpy(getattr(modes.perturbations, name)) for name in _PERTURBATIONS}
    record = {
        "format": FORMAT,
        "version": version("avmsf"),
        "mass": modes.mass,
        "sizes": {
            "modes": len(modes),
            "nodes": len(modes.nodes),
            "triangles": len(modes.triangles),
            "fields": None if modes.perturbations is None else len(modes.perturbations.stiffness),
        },
        "material": asdict(modes.material),
    }
    content = to_bytes(
        {name: tensor.cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()},
        {_KEY: json.dumps(record, allow_nan=False)},
    )
    write_whole(path, lambda place: place.write_bytes(content), raising=SimulationError)


def load_modes(path: str | Path) -> ElasticModes:
    """Read modes that `save_modes` wrote.

    Raises SimulationError for a file that is missing, cut short, of another kind or of another format, and where its
    tensors are not those that its header speaks of.
    """
    path = Path(path)
    words, tensors = _read(path)
    try:
        record = parse_json(words)
        found, writer = record["format"], record["version"]
        if found != FORMAT:
            raise SimulationError(
                f"{path}: expected elastic modes of format {FORMAT}, got format {found}, written by avmsf {writer} "
                f"(this is avmsf {version('avmsf')}); compute them again",
                file=path,
                name="format",
                value=found,
            )
        sizes, material, weight = record["sizes"], Material(**record["material"]), float(record["mass"])
        expected = {
            "frequency": ((sizes["modes"],), torch.float64),
            "nodes": ((sizes["nodes"], 3), torch.float64),
            "triangles": ((sizes["triangles"], 6), torch.int64),
            "shapes": ((sizes["nodes"], sizes["modes"], 3), torch.float64),
        }
        square, fields = (sizes["modes"], sizes["modes"]), sizes["fields"]
        if fields is not None:
            each = ((fields, *square), (fields, *square), square)
            expected |= {name: (shape, torch.float64) for name, shape in zip(_PERTURBATIONS, each, strict=True)}
    except (ValueError, TypeError, KeyError) as error:
        raise SimulationError(
            f"{path}: expected the header of elastic modes, got {error!r}; compute the modes again",
            file=path,
            name="header",
            value=repr(error),
        ) from error
    present = {name: (tuple(tensor.shape), tensor.dtype) for name, tensor in tensors.items()}
    if present != expected:
        raise SimulationError(
            f"{path}: expected the tensors {_told(expected)}, got {_told(present)}; compute the modes again",
            file=path,
            name="tensors",
            value=sorted(present),
        )
    rows = tensors["triangles"]
    if len(rows) and (int(rows.min()) < 0 or int(rows.max()) >= sizes["nodes"]):
        raise SimulationError(
            f"{path}: expected triangles of nodes 0 to {sizes['nodes'] - 1}, got {int(rows.min())} to "
            f"{int(rows.max())}; compute the modes again",
            file=path,
            name="triangles",
            value=[int(rows.min()), int(rows.max())],
        )
    changes = None if fields is None else Perturbations(*(tensors[name].numpy() for name in _PERTURBATIONS))
    return ElasticModes(tensors["frequency"], tensors["nodes"], rows, tensors["shapes"], material, weight, changes)


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


def _read(path: Path) -> tuple[str, dict[str, Tensor]]:
    return read_tensors(path, _KEY, what="elastic modes", advice="compute them again", raising=SimulationError)


def _told(tensors: dict[str, tuple[tuple[int, ...], torch.dtype]]) -> str:
    return ", ".join(f"{name} {list(shape)} {dtype}" for name, (shape, dtype) in sorted(tensors.items()))
