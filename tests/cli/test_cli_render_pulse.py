"""`avmsf render` with a softer mallet."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main
from avmsf.modal.modes import ForcePulse
from factories.made_fields import positional, saved, sounding

PLACE = torch.tensor([[0.05, 0.03, 0.002]], dtype=torch.float64)
AT = ("--position", "0.05", "0.03", "0.002")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return saved(positional(), tmp_path)


@pytest.mark.parametrize(("words", "shape"), [((), "half-sine"), (("--pulse", "hertz"), "hertz")])
def test_render_softens_the_modes(path: Path, tmp_path: Path, words, shape) -> None:
    sound_path = tmp_path / "soft.wav"
    assert main(["render", str(path), *AT, "--output", str(sound_path), "--contact-time", "2e-3", *words]) == 0
    expected = sounding(positional()).render(PLACE, pulse=ForcePulse(2e-3, shape))
    assert np.array_equal(soundfile.read(sound_path, dtype="float32")[0], expected[0].numpy())


def test_without_a_contact_time_a_blow_is_as_recorded(path: Path, tmp_path: Path) -> None:
    assert main(["render", str(path), *AT, "--output", str(tmp_path / "hard.wav")]) == 0
    assert np.array_equal(
        soundfile.read(tmp_path / "hard.wav", dtype="float32")[0], sounding(positional()).render(PLACE)[0].numpy()
    )


def test_the_noise_knows_no_hammer() -> None:
    """Modes alone are softened, so that what a pulse changes is their convolution with it."""
    sound_field, pulse = sounding(positional()), ForcePulse(2e-3)
    noise = sound_field.noise()
    hard, soft = (sound_field.render(PLACE, forces=3.0, pulse=each) for each in (None, pulse))
    expected = 3.0 * (pulse.soften(hard / 3.0 - noise, sample_rate=8000.0) + noise)
    torch.testing.assert_close(soft, expected, rtol=0, atol=1e-6 * float(hard.abs().max()))


@pytest.mark.parametrize("time", ["-0.001", "0.5", "nan"])
def test_a_time_that_is_no_blows_is_refused(path: Path, tmp_path: Path, capsys, time: str) -> None:
    assert main(["render", str(path), *AT, "--output", str(tmp_path / "x.wav"), "--contact-time", time]) == 2
    assert "expected seconds from 0 to 0.02" in capsys.readouterr().err
