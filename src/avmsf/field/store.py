"""A sound field as one file: safetensors, with all that is not a tensor as JSON in its header.

Tensors are named by the path of their field: `bank.frequency`, `phase`, `gains.points`. The header's metadata
holds under the key `avmsf` a record:

{"format": 8, "version": "0.1.0", "sample_rate": 44100.0, "samples": 132300, "background_force": 12.5 or null,
 "sizes": {"modes": 43, "bins": 1025, "recordings": [8, 132300]},
 "gains": {"kind": "attention", the gain model's record},
 "alignment": null or {"modes": 32, "names": [...], "keys": [...]},
 "config": {FitConfig}, "origin": {"capture": "bowl", "trained_on": [...], "per_newton": true, "report": {...},
                                   "settings": {CaptureSettings}}}
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from avmsf._utils.tensor_files import TensorReader, read_tensors, write_tensors
from avmsf._utils.text import RecordError, count_of, like, record_of, without_defaults
from avmsf.capture.audio import HIGHEST_RATE, LOWEST_RATE, MAX_PEAK, MAX_SAMPLES
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import AvmsfError, FieldFileError
from avmsf.fem.material import Material
from avmsf.field.config import ADDED_SETTINGS, FIELD, REMOVED_SETTINGS, FitConfig
from avmsf.field.gains.model import GainModel
from avmsf.field.gains.scaled import FITTED, ScaledGains
from avmsf.field.quality import FieldQuality, ProbableBody
from avmsf.field.sound_field import SUPPORTING, Origin, SoundField
from avmsf.modal.extraction.alignment import Alignment
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual

_GAINS, _ALIGNMENT = "gains.", "alignment."
_POSITIVE = ("bank.frequency", "bank.damping")
_MAX = {"bank.frequency": 1e9, "bank.damping": 1e9, "residual.magnitude": MAX_PEAK}
"""Largest values: hertz and 1/s beyond any solid's modes, and noise as loud as the loudest recording."""
_RENAMED_EDITS = {"recast": "change_material", "retune": "adjust_modes", "steer": "guided"}
"""Kinds of edits that earlier versions wrote, and what they are called now."""
_KINDS: dict[str, type[GainModel]] = {**FITTED, ScaledGains.kind: ScaledGains}
"""The gain fields that a file may hold, by what it calls them."""


def save(field: SoundField, path: str | Path) -> None:
    """Write a field to one file, which `load` reads back to the last bit.

    A file that is there is replaced in one step and stays whole until then; folders that are missing are made. Raises
    `FieldFileError` where the file cannot be written, and for a field that could not be read back.
    """
    path, tensors = Path(path), _tensors(field)
    text = FIELD.to_text(_record(field), path, name="origin.report")
    _read(json.loads(text), tensors, path)
    write_tensors(path, tensors, text, FIELD)


def load(path: str | Path) -> SoundField:
    """Read a field that `save` wrote; it renders what the saved one does, to the last bit.

    Args:
        path: The .safetensors file.

    Returns:
        The field.

    Raises:
        FieldFileError: For a file that is missing, cut short, of another kind or of a newer format, and where a tensor
            is missing, unexpected, of another shape or dtype, or not finite.
    """
    path = Path(path)
    text, tensors = read_tensors(path, FIELD)
    return _read(FIELD.parse(text, path), tensors, path)


@contextmanager
def _reporting_damage(path: Path) -> Iterator[None]:
    """Turn what a record or tensors of another form raise into FieldFileError."""
    try:
        yield
    except FieldFileError:
        raise
    # RuntimeError: torch, of sizes beyond 2^63 and of damaged values.
    except (ValueError, TypeError, KeyError, RuntimeError, AvmsfError) as error:
        raise FIELD.damaged(path, error) from error


def _read(record: Mapping[str, Any], tensors: Mapping[str, Tensor], path: Path) -> SoundField:
    """Return the field that has this record and tensors, all of which is checked."""
    with _reporting_damage(path):
        rate, samples = like(record["sample_rate"], 1.0, "sample_rate"), count_of(record["samples"], "samples")
        # Those of the recordings that a field is fitted to.
        if not LOWEST_RATE <= rate <= HIGHEST_RATE:
            raise RecordError.expected(f"{LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz", rate, name="sample_rate")
        if samples > MAX_SAMPLES:
            raise RecordError.expected(f"at most {MAX_SAMPLES:,}", samples, got=f"{samples:,}", name="samples")
        sizes, gains = (dict(like(record[name], {}, name)) for name in ("sizes", "gains"))
        modes = count_of(sizes["modes"], "sizes.modes")
        if gains["modes"] != modes:
            raise RecordError.expected(f"{modes}, the number of frequencies", gains["modes"], name="gains.modes")
        origin, read = _origin(record, modes), TensorReader(tensors, path, FIELD)
        bank = ModalBank(read("bank.frequency", modes), read("bank.damping", modes))
        phase, residual = read("phase", modes), _residual(record, read)
        for name, highest in _MAX.items():
            low, high = (float(each) for each in tensors[name].aminmax())
            if low < 0.0 or (low == 0.0 and name in _POSITIVE) or high > highest:
                wanted = f"{name} {'above' if name in _POSITIVE else 'of at least'} 0, and up to {highest:g}"
                got = f"{low:.3g} to {high:.3g}"
                raise FieldFileError.expected(wanted, (low, high), got=got, file=path, name=name, advice=FIELD.advice)
        kind = like(gains["kind"], "", "gains.kind")
        if kind not in _KINDS:
            raise RecordError.expected(", ".join(_KINDS), kind, name="gains.kind")
        model, alignment = _KINDS[kind].restore(gains, read.within(_GAINS)), None
        if (kept := record["alignment"]) is not None:
            names, keys = (like(kept[name], [], f"alignment.{name}") for name in ("names", "keys"))
            if len(names) != len(keys) or not all(isinstance(each, str) for each in (*names, *keys)):
                raise RecordError.expected(f"{len(names)} as in alignment.names", len(keys), name="alignment.keys")
            poles = count_of(kept["modes"], "alignment.modes", least=0)
            alignment = Alignment.restore(read.within(_ALIGNMENT), names, keys, poles)
        read.expect_end()
        return SoundField(bank, model, phase, residual, float(rate), samples, origin, alignment)


def _origin(record: Mapping[str, Any], modes: int) -> Origin:
    origin, config = dict(like(record["origin"], {}, "origin")), like(record["config"], {}, "config")
    config = {name: value for name, value in config.items() if name not in REMOVED_SETTINGS}
    read = Origin(
        capture=like(origin["capture"], "", "origin.capture"),
        trained_on=tuple(like(name, "", "origin.trained_on") for name in origin["trained_on"]),
        per_newton=like(origin["per_newton"], True, "origin.per_newton"),
        config=record_of(FitConfig, config, "config", added=ADDED_SETTINGS),
        report=_checked_report(like(origin["report"], {}, "origin.report"), modes),
        settings=record_of(CaptureSettings, origin["settings"], "origin.settings", added=asdict(CaptureSettings())),
    )
    if (quality := read.report.get("quality")) is not None:
        FieldQuality.of(quality)
    _ = ProbableBody.of(read.report)
    return read


def _residual(record: Mapping[str, Any], read: TensorReader) -> Residual:
    # Not in files of versions before 0.9, whose noise grows with the force.
    force, sizes, recordings = record.get("background_force"), record["sizes"], None
    if force is not None and not 0.0 < like(force, 1.0, "background_force") < math.inf:
        raise RecordError.expected("a force above 0, or null", force, name="background_force")
    magnitude = read("residual.magnitude", count_of(sizes["bins"], "sizes.bins"), dtype=torch.float32)
    if sizes["recordings"] is not None:
        contacts, length = (count_of(each, "sizes.recordings") for each in sizes["recordings"])
        if record["gains"].get("contacts") != contacts:
            wanted = f"{record['gains'].get('contacts')} contacts as in gains"
            raise RecordError.expected(wanted, contacts, name="sizes.recordings")
        recordings = read("residual.recordings", contacts, length, dtype=torch.float32)
    return Residual(magnitude, recordings, force)


def _checked_report(report: dict[str, Any], modes: int) -> dict[str, Any]:
    """Return the checked report on a field of so many modes, with its edits called as this version calls them."""
    for row, pole in enumerate(like(report.get(SUPPORTING, []), [], f"origin.report.{SUPPORTING}")):
        name = f"origin.report.{SUPPORTING}.{row}"
        if not 0 <= like(pole, 0, name) < modes:
            raise RecordError.expected(f"a row from 0 to {modes - 1}", pole, name=name)
    edits = like(report.get("edits", []), [], "origin.report.edits")
    found = [_edit_of(entry, f"origin.report.edits.{row}", modes) for row, entry in enumerate(edits)]
    return {**report, "edits": found} if found else report


def _edit_of(entry: Any, name: str, modes: int) -> dict[str, Any]:
    known: dict[str, Any] = like(entry, {}, name)
    written = like(known.get("edit"), "", f"{name}.edit")
    kind = _RENAMED_EDITS.get(written, written)
    if kind == "change_material":
        record_of(Material, known.get("to"), f"{name}.to")
    if kind == "adjust_modes":
        for key in ("pitch", "decay"):
            factors = known.get(key)
            for factor in factors if isinstance(factors, list) and len(factors) == modes else [factors]:
                if not 0.0 < like(factor, 1.0, f"{name}.{key}") < math.inf:
                    raise RecordError.expected("a number above 0", factor, name=f"{name}.{key}")
    return {**known, "edit": kind}


def _record(field: SoundField) -> dict[str, Any]:
    origin = {name: getattr(field.origin, name) for name in ("capture", "trained_on", "per_newton", "report")}
    recordings, alignment = field.residual.recordings, field.alignment
    return {
        "sample_rate": field.sample_rate,
        "samples": field.samples,
        "background_force": field.residual.force,
        "sizes": {
            "modes": len(field.bank),
            "bins": len(field.residual.magnitude),
            "recordings": None if recordings is None else list(recordings.shape),
        },
        "gains": {"kind": field.gain_field.kind, **field.gain_field.record()},
        "alignment": None
        if alignment is None
        else {"modes": len(alignment.bank), "names": alignment.names, "keys": alignment.keys},
        "config": without_defaults(asdict(field.origin.config), ADDED_SETTINGS) | REMOVED_SETTINGS,
        "origin": origin | {"settings": asdict(field.origin.settings)},
    }


def _tensors(field: SoundField) -> dict[str, Tensor]:
    named = {f"bank.{name}": each for name, each in vars(field.bank).items()} | {"phase": field.phase}
    named |= {f"residual.{name}": each for name, each in vars(field.residual).items() if isinstance(each, Tensor)}
    if field.alignment is not None:
        named |= {_ALIGNMENT + name: tensor for name, tensor in field.alignment.tensors().items()}
    return named | {_GAINS + name: tensor for name, tensor in field.gain_field.tensors().items()}
