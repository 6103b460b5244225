"""`avmsf render`: noise, levels, softer hammers and directions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main
from avmsf.modal.config import PulseShape
from avmsf.modal.modes import ForcePulse
from factories.made_fields import directional, positional, saved, sounding
from factories.verbs import results_of

AT = ("--position", "0.05", "0.03", "0.002")
PLACE = torch.tensor([[0.05, 0.03, 0.002]], dtype=torch.float64)
PLACES = torch.tensor([[0.05, 0.03, 0.002], [0.05, 0.03, 0.002], [-0.04, 0.01, 0.002]], dtype=torch.float64)
DIRECTIONS = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
Streams = pytest.CaptureFixture[str]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return saved(positional(), tmp_path)


def rendered(path: Path, capsys: Streams, *words: str) -> tuple[np.ndarray, dict, list[str]]:
    """Return the sound, the JSON and the notes of a command."""
    output = path.with_name("a.wav")
    told, err = results_of(capsys, "render", path, *AT, "--output", output, *words)
    notes = [line for line in err.splitlines() if line.startswith("note: ")]
    return soundfile.read(output, dtype="float32")[0], told, notes


@pytest.mark.parametrize("words", [(), ("--contact-time", "0.002")])
def test_without_noise_the_modes_are_rendered(path: Path, capsys: Streams, words: tuple[str, ...]) -> None:
    noisy, modes = (rendered(path, capsys, *words, *more)[0] for more in ((), ("--no-noise",)))
    # The sounds are float32, of peaks near 1.
    assert np.abs(noisy - modes - sounding(positional()).noise().numpy()).max() < 1e-6
    assert words or np.array_equal(modes, sounding(positional()).render(PLACE, noise=False)[0].numpy())


def test_without_a_force_a_sound_is_as_the_recordings_on_average(tmp_path: Path, capsys: Streams) -> None:
    field = sounding(positional())
    field = replace(field, residual=replace(field.residual, force=50.0))
    field.save(tmp_path / "field.safetensors")
    for words, force in (((), None), (("--force", "3"), 3.0)):
        sound = rendered(tmp_path / "field.safetensors", capsys, *words)[0]
        assert np.array_equal(sound, field.render(PLACE, forces=force)[0].numpy())


@pytest.mark.parametrize("level", [-30.0, -10.0, 20.0])
def test_the_peak_of_what_is_written_is_said(path: Path, capsys: Streams, level: float) -> None:
    loudest = 20 * np.log10(float(sounding(positional()).render(PLACE).abs().max()))
    sound, told, notes = rendered(path, capsys, "--level-db", str(level - loudest))
    assert told["peak_dbfs"] == pytest.approx(level, abs=1e-3)
    assert np.abs(sound).max() == pytest.approx(10 ** (level / 20), rel=1e-4)
    # Quiet ones and those that clip are noted, once.
    advised = [note for note in notes if "--normalize peak" in note]
    assert len(advised) == (0 if level == -10 else 1)


@pytest.mark.parametrize("shape", ["half-sine", "hertz"])
def test_render_softens_the_modes(path: Path, shape: PulseShape, capsys: Streams) -> None:
    sound, _, _ = rendered(path, capsys, "--contact-time", "2e-3", "--pulse", shape)
    expected = sounding(positional()).render(PLACE, pulse=ForcePulse(2e-3, shape))
    assert np.array_equal(sound, expected[0].numpy())


def test_directions_of_a_table_are_rendered(tmp_path: Path) -> None:
    rows = [
        f"{number}.wav,{','.join(map(str, place))},{','.join(map(str, way)) if any(way) else ',,'}"
        for number, (place, way) in enumerate(zip(PLACES.tolist(), DIRECTIONS.tolist(), strict=True))
    ]
    (tmp_path / "impacts.csv").write_text("\n".join(["file,x,y,z,nx,ny,nz", *rows]) + "\n")
    table = ("--contact-table", str(tmp_path / "impacts.csv"))
    assert main(["render", str(saved(directional(), tmp_path)), *table, "--output", str(tmp_path / "all")]) == 0
    expected = sounding(directional()).render(PLACES, directions=DIRECTIONS)
    for number, sound in enumerate(expected):
        found = soundfile.read(tmp_path / "all" / f"{number}.wav", dtype="float32")[0]
        assert np.array_equal(found, sound.numpy())
    assert not torch.equal(expected[0], expected[1])


def test_the_direction_of_a_contact_is_rendered(tmp_path: Path) -> None:
    words = ["--position", "0.05", "0.03", "0.002", "--direction", "0", "0", "1", "--output", str(tmp_path / "up.wav")]
    assert main(["render", str(saved(directional(), tmp_path)), *words]) == 0
    expected = sounding(directional()).render(PLACES[1:2], directions=DIRECTIONS[1:2])[0]
    assert np.array_equal(soundfile.read(tmp_path / "up.wav", dtype="float32")[0], expected.numpy())
