"""A field's file cannot ask for sounds that no recording has, and no sound that is not finite is written."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import soundfile
import torch
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from avmsf.cli import main
from avmsf.cli.options.checks import OutputError
from avmsf.cli.writing import write_sound
from avmsf.errors import FieldFileError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, FIELDS
from factories.raising import raises


def field() -> SoundField:
    gains, phase = FIELDS["positional"](), torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, gains, phase, Residual(torch.full((9,), 1e-3)), 8000.0, 800, Origin("plate"))


def write_changed(path: Path, *, words: str | None = None, noise: float = 1e-3, **changes: Any) -> Path:
    """Write a field whose header has other entries, or is other words."""
    save(field(), path)
    content = path.read_bytes()
    metadata = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
    tensors = from_bytes(content)
    tensors["residual.magnitude"][:] = noise
    record = json.loads(metadata["avmsf"])
    record["gains"] |= changes.pop("gains", {})
    record = json.dumps(record | changes)
    path.write_bytes(to_bytes(tensors, metadata | {"avmsf": record if words is None else words}))
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"samples": 10**9}, {"samples": 10**12}, {"sample_rate": 1e300}, {"sample_rate": 1e-300},
        {"sample_rate": 10**400}, {"noise": 1e38},
        {"words": "[" * 100_000}, {"gains": {"modes": 10**30}},
    ],
    ids=lambda changes: str(changes)[:30],
)  # fmt: skip
def test_headers_beyond_all_sounds_are_refused(tmp_path: Path, changes: dict) -> None:
    with raises(FieldFileError, file="x.safetensors"):
        load(write_changed(tmp_path / "x.safetensors", **changes))


def test_what_could_not_be_loaded_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(FieldFileError):
        save(replace(field(), samples=10**9), tmp_path / "x.safetensors")
    assert not list(tmp_path.iterdir())


def test_no_sound_that_is_not_finite_is_written(tmp_path: Path) -> None:
    for value in (float("nan"), float("inf")):
        sound = torch.zeros(100)
        sound[7] = value
        with raises(OutputError, file="x.wav", name="finite", value=1):
            write_sound(tmp_path / "x.wav", sound, sample_rate=8000.0, coding="float32")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("words", "code"), [((), 0), (("--force", "1e38"), 2), (("--seconds", "1e9"), 2)])
def test_render_writes_finite_sounds_or_none(tmp_path: Path, words: tuple[str, ...], code: int) -> None:
    save(replace(field(), residual=Residual(torch.full((9,), 1e6))), tmp_path / "x.safetensors")
    output = tmp_path / "x.wav"
    place = ("--position", "0.01", "0.02", "0.002", "--output", str(output))
    assert main(["render", str(tmp_path / "x.safetensors"), *place, *words]) == code
    assert output.exists() == (code == 0)
    if code == 0:
        assert len(soundfile.read(output)[0]) == 800
