"""All of a sound field that is no tensor, as the JSON in its file's header.

{"format": 2, "version": "0.1.0", "sample_rate": 44100.0, "samples": 132300,
 "sizes": {"points": 8192, "dim": 3, "modes": 43, "bins": 1025},
 "gain_field": {"kind": "attention", "encoder": "geometry", "shape": {AttentionShape}},
 "config": {FitConfig}, "origin": {"capture": "bowl", "trained_on": [...], "per_newton": true, "report": {...}}}
"""

import json
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from avmsf.errors import FieldFileError, FitError
from avmsf.field.config import FitConfig
from avmsf.field.gains import AttentionShape
from avmsf.field.soundfield import Origin, SoundField

FORMAT = 2
"""Number of this format; it grows with every change that older versions could not read."""
_KIND = "attention"

_Record = TypeVar("_Record", AttentionShape, FitConfig)


@dataclass(frozen=True)
class Header:
    """What a field's file says about its tensors."""

    sample_rate: float
    """Hz."""
    samples: int
    """Length of rendered sounds."""
    points: int
    """Points that contacts are looked up in."""
    dim: int
    """Length of a point's feature."""
    modes: int
    bins: int
    """Bands of the residual."""
    encoder: str
    """Who made the features."""
    shape: AttentionShape
    origin: Origin

    @classmethod
    def of(cls, field: SoundField) -> "Header":
        """Return a field's header."""
        network = field.gain_field
        return cls(
            sample_rate=field.sample_rate,
            samples=field.samples,
            points=network.points.shape[0],
            dim=network.features.shape[1],
            modes=len(field.bank),
            bins=len(field.residual.magnitude),
            encoder=network.encoder,
            shape=network.shape,
            origin=field.origin,
        )

    def to_json(self, path: Path) -> str:
        """Return the record as text for the file `path`, or raise `FieldFileError` where the report is none."""
        origin = {name: getattr(self.origin, name) for name in ("capture", "trained_on", "per_newton", "report")}
        record = {
            "format": FORMAT,
            "version": version("avmsf"),
            "sample_rate": self.sample_rate,
            "samples": self.samples,
            "sizes": {"points": self.points, "dim": self.dim, "modes": self.modes, "bins": self.bins},
            "gain_field": {"kind": _KIND, "encoder": self.encoder, "shape": asdict(self.shape)},
            "config": asdict(self.origin.config),
            "origin": origin,
        }
        try:
            return json.dumps(record, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise FieldFileError(
                f"{path}: expected origin.report to hold finite numbers, words, lists and dicts ({error}): take the "
                "rest out of it"
            ) from error


def read_header(words: str, path: Path) -> Header:
    """Return the record that the file `path` holds. Raises `FieldFileError` for one that this version cannot read."""
    try:
        record = json.loads(words)
        found, writer = record["format"], record["version"]
    except (ValueError, TypeError, KeyError) as error:
        raise _broken(path, error) from error
    if found != FORMAT:
        raise FieldFileError(
            f"{path}: expected a sound field of format {FORMAT}, found format {found}, written by avmsf {writer} "
            f"(this is avmsf {version('avmsf')}): install avmsf {writer} or newer"
        )
    try:
        return _header(record)
    except (ValueError, TypeError, KeyError, FitError) as error:
        raise _broken(path, error) from error


def _header(record: dict[str, Any]) -> Header:
    sizes, network, origin = record["sizes"], record["gain_field"], record["origin"]
    if network["kind"] != _KIND:
        raise ValueError(f"gain_field.kind is {network['kind']!r}, not {_KIND!r}")
    rate = float(_like(record["sample_rate"], 1.0, "sample_rate"))
    if not 0 < rate < float("inf"):
        raise ValueError(f"sample_rate is {rate}")
    return Header(
        sample_rate=rate,
        samples=_count(record["samples"], "samples"),
        **{name: _count(sizes[name], f"sizes.{name}") for name in ("points", "dim", "modes", "bins")},
        encoder=_like(network["encoder"], "", "gain_field.encoder"),
        shape=_record_of(FitConfig().shape, network["shape"], "gain_field.shape"),
        origin=Origin(
            capture=_like(origin["capture"], "", "origin.capture"),
            trained_on=tuple(_like(name, "", "origin.trained_on") for name in origin["trained_on"]),
            per_newton=_like(origin["per_newton"], True, "origin.per_newton"),
            config=_record_of(FitConfig(), record["config"], "config"),
            report=_like(origin["report"], {}, "origin.report"),
        ),
    )


def _record_of(example: _Record, values: dict[str, Any], name: str) -> _Record:
    """Build a record of settings from exactly the example's fields, each of the type that it has there."""
    examples = {each.name: getattr(example, each.name) for each in fields(example)}
    if values.keys() != examples.keys():
        differing = ", ".join(sorted(values.keys() ^ examples.keys()))
        raise ValueError(f"{name} lacks or adds {differing}")
    return type(example)(**{each: _like(value, examples[each], f"{name}.{each}") for each, value in values.items()})


def _like(value: Any, example: Any, name: str) -> Any:
    """Return a JSON value as the type of `example`, or raise TypeError."""
    if isinstance(example, tuple) and isinstance(value, list):
        return tuple(_like(each, example[0], name) for each in value)
    if isinstance(example, float) and type(value) is int:
        return float(value)
    if type(value) is not type(example):
        raise TypeError(f"{name} is {value!r}, not of type {type(example).__name__}")
    return value


def _count(value: Any, name: str) -> int:
    if _like(value, 1, name) < 1:
        raise ValueError(f"{name} is {value}")
    return int(value)


def _broken(path: Path, error: Exception) -> FieldFileError:
    return FieldFileError(
        f"{path}: expected the header of a sound field of format {FORMAT}, found another or a damaged one "
        f"({type(error).__name__}: {error}): fit and save the field again"
    )
