"""All of a sound field that is no tensor, as the JSON in its file's header.

{"format": 7, "version": "0.1.0", "sample_rate": 44100.0, "samples": 132300,
 "sizes": {"modes": 43, "bins": 1025, "recordings": [8, 132300]},
 "gain_field": {"kind": "attention", what the gain field says of itself},
 "config": {FitConfig}, "origin": {"capture": "bowl", "trained_on": [...], "per_newton": true, "report": {...},
                                   "settings": {CaptureSettings}}}
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import Tensor

from avmsf._utils.records import count_of, like, record_of
from avmsf._utils.text_files import parse_json
from avmsf.capture.audio import HIGHEST_RATE, LOWEST_RATE, MAX_SAMPLES
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, FieldFileError, FitError
from avmsf.field.config import FitConfig
from avmsf.field.soundfield import Origin, SoundField

FORMAT = 7
"""Number of this format; it grows with every change that older versions could not read."""


@dataclass(frozen=True)
class Header:
    """What a field's file says about its tensors. Raises ValueError for sounds that no recording has."""

    sample_rate: float
    """Hz."""
    samples: int
    """Length of rendered sounds."""
    modes: int
    bins: int
    """Bands of the residual."""
    recordings: tuple[int, int] | None
    """Contacts and samples of the residual's recordings, where it has any."""
    kind: str
    """What sort of gain field it is."""
    gain_field: Mapping[str, Any]
    """What the gain field says of itself."""
    origin: Origin

    def __post_init__(self) -> None:
        # Those of the recordings that a field is fitted to.
        if not LOWEST_RATE <= self.sample_rate <= HIGHEST_RATE:
            raise ValueError(f"sample_rate: expected {LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz, got {self.sample_rate:g}")
        if self.samples > MAX_SAMPLES:
            raise ValueError(f"samples: expected at most {MAX_SAMPLES:,}, got {self.samples:,}")

    @classmethod
    def of(cls, field: SoundField) -> "Header":
        """Return a field's header."""
        return cls(
            sample_rate=field.sample_rate,
            samples=field.samples,
            modes=len(field.bank),
            bins=len(field.residual.magnitude),
            recordings=_sizes(field.residual.recordings),
            kind=field.gain_field.kind,
            gain_field=field.gain_field.record(),
            origin=field.origin,
        )

    def to_json(self, path: Path) -> str:
        """Return the record as text for the file `path`, or raise `FieldFileError` where the report is none."""
        origin = {name: getattr(self.origin, name) for name in ("capture", "trained_on", "per_newton", "report")}
        origin["settings"] = asdict(self.origin.settings)
        record = {
            "format": FORMAT,
            "version": version("avmsf"),
            "sample_rate": self.sample_rate,
            "samples": self.samples,
            "sizes": {"modes": self.modes, "bins": self.bins, "recordings": self.recordings},
            "gain_field": {"kind": self.kind, **self.gain_field},
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
        record = parse_json(words)
        found, writer = record["format"], record["version"]
    except (ValueError, TypeError, KeyError) as error:
        raise broken(path, error) from error
    if found != FORMAT:
        raise FieldFileError(
            f"{path}: expected a sound field of format {FORMAT}, found format {found}, written by avmsf {writer} "
            f"(this is avmsf {version('avmsf')}): "
            + ("fit the field again" if isinstance(found, int) and found < FORMAT else "install a newer avmsf")
        )
    try:
        return _header(record)
    except (ValueError, TypeError, KeyError, FitError, CaptureError) as error:
        raise broken(path, error) from error


def _header(record: dict[str, Any]) -> Header:
    sizes, gains, origin = record["sizes"], dict(record["gain_field"]), record["origin"]
    return Header(
        sample_rate=float(like(record["sample_rate"], 1.0, "sample_rate")),
        samples=count_of(record["samples"], "samples"),
        modes=count_of(sizes["modes"], "sizes.modes"),
        bins=count_of(sizes["bins"], "sizes.bins"),
        recordings=None if sizes["recordings"] is None else _shape_of(sizes["recordings"]),
        kind=like(gains.pop("kind"), "", "gain_field.kind"),
        gain_field=gains,
        origin=Origin(
            capture=like(origin["capture"], "", "origin.capture"),
            trained_on=tuple(like(name, "", "origin.trained_on") for name in origin["trained_on"]),
            per_newton=like(origin["per_newton"], True, "origin.per_newton"),
            config=record_of(FitConfig(), record["config"], "config"),
            report=like(origin["report"], {}, "origin.report"),
            settings=CaptureSettings.of(like(origin["settings"], {}, "origin.settings"), name="origin.settings"),
        ),
    )


def _sizes(recordings: Tensor | None) -> tuple[int, int] | None:
    return None if recordings is None else (recordings.shape[0], recordings.shape[1])


def _shape_of(sizes: Any) -> tuple[int, int]:
    contacts, samples = (count_of(each, "sizes.recordings") for each in sizes)
    return contacts, samples


def broken(path: Path, error: Exception) -> FieldFileError:
    """Return what to raise for a header that this format does not allow."""
    return FieldFileError(
        f"{path}: expected the header of a sound field of format {FORMAT}, found another or a damaged one "
        f"({type(error).__name__}: {error}): fit and save the field again"
    )
