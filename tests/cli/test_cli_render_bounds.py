"""No sound that is not finite is written."""

from dataclasses import replace
from pathlib import Path

import pytest
import soundfile
import torch

from avmsf.cli import main
from avmsf.cli.paths import OutputError
from avmsf.cli.writing import write_sound
from avmsf.field.store import save
from avmsf.modal.residual_noise import Residual
from factories.made_fields import positional, sounding
from factories.raising import raises


def test_no_sound_that_is_not_finite_is_written(tmp_path: Path) -> None:
    for value in (float("nan"), float("inf")):
        sound = torch.zeros(100)
        sound[7] = value
        with raises(OutputError, file="x.wav", name="finite", value=1):
            write_sound(tmp_path / "x.wav", sound, sample_rate=8000.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("words", "code"), [((), 0), (("--force", "1e38"), 2), (("--seconds", "1e9"), 2)])
def test_render_writes_finite_sounds_or_none(tmp_path: Path, words: tuple[str, ...], code: int) -> None:
    save(replace(sounding(positional()), residual=Residual(torch.full((9,), 1e6))), tmp_path / "x.safetensors")
    output = tmp_path / "x.wav"
    place = ("--position", "0.01", "0.02", "0.002", "--output", str(output))
    assert main(["render", str(tmp_path / "x.safetensors"), *place, *words]) == code
    assert output.exists() == (code == 0)
    if code == 0:
        assert len(soundfile.read(output)[0]) == 2000
