"""A feature field as one file: safetensors with `points` and `features`, and one JSON in the header for the rest.

{"format": 1, "version": "0.1.0", "encoder": "descriptors", "sizes": {"points": 8192, "dim": 36}, "report": {...}}
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avmsf._utils.headers import FEATURES_KEY, FileKind
from avmsf._utils.tensor_files import expect_tensors, read_tensors, write_tensors
from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField

_KIND = FileKind(FEATURES_KEY, "a file of features", "compute the features again", SceneError, formats=(1,))


def save_features(features: FeatureField, path: str | Path, *, report: dict[str, Any] | None = None) -> None:
    """Write features to one file, which `load_features` reads back to the last bit.

    `report` is saved with them as JSON. An existing file is replaced only when the new one is complete. Raises
    SceneError where the file cannot be written, or could not be read back.
    """
    path = Path(path)
    tensors = {"points": features.points.float(), "features": features.features.float()}
    record = {
        "encoder": features.encoder,
        "sizes": {"points": features.features.shape[0], "dim": features.features.shape[1]},
        "report": report or {},
    }
    expect_tensors(tensors, _skeleton(record), path, _KIND)
    write_tensors(path, tensors, _KIND.to_text(record, path, name="report"), _KIND)


def load_features(path: str | Path) -> FeatureField:
    """Read features that `save_features` wrote.

    Raises SceneError for a file that is missing, truncated, of another kind or of another format, and where its tensors
    are not those of its header.
    """
    record, tensors = _read(Path(path))
    return FeatureField(tensors["points"], tensors["features"], record["encoder"])


def read_report(path: str | Path) -> dict[str, Any]:
    """Return the report that features were saved with. Raises SceneError as `load_features`."""
    return _read(Path(path))[0]["report"]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the header's record and the tensors, both checked."""
    text, tensors = read_tensors(path, _KIND)
    record = _KIND.parse(text, path, _check_record)
    expect_tensors(tensors, _skeleton(record), path, _KIND)
    return record, tensors


def _check_record(record: dict[str, Any]) -> None:
    counts = [record["sizes"][name] for name in ("points", "dim")]
    kinds = isinstance(record["encoder"], str) and isinstance(record["report"], dict)
    if not kinds or any(type(count) is not int or count < 1 for count in counts):
        raise ValueError(f"sizes {record['sizes']}, encoder {record['encoder']!r}")


def _skeleton(record: dict[str, Any]) -> dict[str, Tensor]:
    points, dim = (record["sizes"][name] for name in ("points", "dim"))
    return {name: torch.empty(points, size, device="meta") for name, size in (("points", 3), ("features", dim))}
