"""A feature field as one file: safetensors with `points` and `features`, and one JSON in the header for the rest.

{"format": 1, "version": "0.1.0", "encoder": "descriptors", "sizes": {"points": 8192, "dim": 36}, "report": {...}}
"""

import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as to_bytes
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.state import read_tensors
from avmsf._utils.text import parse_json
from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.features.header import KEY

FORMAT = 1
"""Number of this format; it grows with every change that older versions could not read."""
_ADVICE = "compute the features again"


def save_features(features: FeatureField, path: str | Path, *, report: dict[str, Any] | None = None) -> None:
    """Write features to one file, which `load_features` reads back to the last bit.

    `report` is saved with them as JSON. An existing file is replaced only when the new one is
    complete. Raises SceneError where the file cannot be written, or could not be read back.
    """
    path = Path(path)
    tensors = {
        name: tensor.detach().float().cpu().clone(memory_format=torch.contiguous_format)
        for name, tensor in (("points", features.points), ("features", features.features))
    }
    record = {
        "format": FORMAT,
        "version": version("avmsf"),
        "encoder": features.encoder,
        "sizes": {"points": features.features.shape[0], "dim": features.features.shape[1]},
        "report": report or {},
    }
    _check_finite(tensors, path)
    try:
        text = json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        got = f"other values ({error})"
        raise SceneError.expected(
            "a report of finite numbers, text, lists and dicts", got=got, file=path, name="report"
        ) from error
    content = to_bytes(tensors, {KEY: text})
    write_whole(path, lambda place: place.write_bytes(content), raising=SceneError)


def load_features(path: str | Path) -> FeatureField:
    """Read features that `save_features` wrote.

    Raises SceneError for a file that is missing, truncated, of another kind or of another format, and where its tensors
    are not those of its header.
    """
    path = Path(path)
    text, tensors = _read(path)
    record = _parse_record(text, path)
    sizes = record["sizes"]
    expected = {"points": (sizes["points"], 3), "features": (sizes["points"], sizes["dim"])}
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items() if tensor.dtype == torch.float32}
    if found != expected or tensors.keys() != expected.keys():
        shapes = {name: list(tensor.shape) for name, tensor in tensors.items()}
        raise SceneError.expected(f"the float32 tensors {expected}", shapes, file=path, name="tensors", advice=_ADVICE)
    _check_finite(tensors, path)
    return FeatureField(tensors["points"], tensors["features"], record["encoder"])


def read_report(path: str | Path) -> dict[str, Any]:
    """Return the report that features were saved with. Raises SceneError as `load_features`."""
    path = Path(path)
    return _parse_record(_read(path)[0], path)["report"]


def _read(path: Path) -> tuple[str, dict[str, Tensor]]:
    return read_tensors(path, KEY, what="a file of features", advice=_ADVICE, raising=SceneError)


def _parse_record(text: str, path: Path) -> dict[str, Any]:
    """Return the header's record after checking every entry of it."""
    try:
        record = parse_json(text)
        found, writer = record["format"], record["version"]
        if found == FORMAT:
            counts = [record["sizes"][name] for name in ("points", "dim")]
            kinds = isinstance(record["encoder"], str) and isinstance(record["report"], dict)
            if not kinds or any(type(count) is not int or count < 1 for count in counts):
                raise ValueError(f"sizes {record['sizes']}, encoder {record['encoder']!r}")
    except (ValueError, TypeError, KeyError) as error:
        got = f"a damaged one ({type(error).__name__}: {error})"
        raise SceneError.expected(
            "the header of a file of features", got=got, file=path, name="header", advice=_ADVICE
        ) from error
    if found != FORMAT:
        raise SceneError.expected(
            f"features of format {FORMAT}",
            found,
            got=f"format {found}, written by avmsf {writer} (this is avmsf {version('avmsf')})",
            file=path,
            name="format",
            advice=f"install avmsf {writer} or newer, or {_ADVICE}",
        )
    return record


def _check_finite(tensors: dict[str, Tensor], path: Path) -> None:
    for name, tensor in tensors.items():
        if not tensor.numel() or not bool(torch.isfinite(tensor).all()):
            raise SceneError.expected(
                f"finite numbers as {name}", got="others or none", file=path, name=name, advice=_ADVICE
            )
