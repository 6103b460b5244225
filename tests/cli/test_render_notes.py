"""`avmsf render`: noise, the level of what is written, and what it says of a table."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main
from avmsf.cli.contacts import read_contacts
from factories.made_fields import positional, saved, sounding

AT = ("--position", "0.05", "0.03", "0.002")
PLACE = torch.tensor([[0.05, 0.03, 0.002]], dtype=torch.float64)
Streams = pytest.CaptureFixture[str]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return saved(positional(), tmp_path)


def rendered(path: Path, capsys: Streams, *words: str) -> tuple[np.ndarray, dict, list[str]]:
    """Return the sound, the JSON and the notes of a command."""
    output = path.with_name("a.wav")
    capsys.readouterr()
    assert main(["render", str(path), *AT, "--output", str(output), "--json", *words]) == 0
    out, err = capsys.readouterr()
    notes = [line for line in err.splitlines() if line.startswith("note: ")]
    return soundfile.read(output, dtype="float32")[0], json.loads(out), notes


@pytest.mark.parametrize("words", [(), ("--contact-time", "0.002")])
def test_without_noise_the_modes_are_rendered(path: Path, capsys: Streams, words: tuple[str, ...]) -> None:
    noisy, modes = (rendered(path, capsys, *words, *more)[0] for more in ((), ("--no-noise",)))
    # The sounds are float32, of peaks near 1.
    assert np.abs(noisy - modes - sounding(positional()).noise().numpy()).max() < 1e-6
    assert words or np.array_equal(modes, sounding(positional()).render(PLACE, noise=False)[0].numpy())


@pytest.mark.parametrize("level", [-30.0, -10.0, 20.0])
def test_the_peak_of_what_is_written_is_said(path: Path, capsys: Streams, level: float) -> None:
    loudest = 20 * np.log10(float(sounding(positional()).render(PLACE).abs().max()))
    sound, told, notes = rendered(path, capsys, "--level-db", str(level - loudest))
    assert told["peak_dbfs"] == pytest.approx(level, abs=1e-3)
    assert np.abs(sound).max() == pytest.approx(10 ** (level / 20), rel=1e-4)
    # Quiet ones and those that clip are noted, once.
    advised = [note for note in notes if "--normalize peak" in note]
    assert len(advised) == (0 if level == -10 else 1)


def test_columns_that_are_not_used_are_named(path: Path, tmp_path: Path, capsys: Streams) -> None:
    table = tmp_path / "places.csv"
    table.write_text("File,x,y,z,nz,Hammer,force_newtons\na,0.05,0.03,0.002,1,felt,2\nb,0.02,0.03,0.002,1,felt,2\n")
    assert read_contacts(table, meters=1.0).unused == ("hammer", "force_newtons")
    assert main(["render", str(path), "--contact-table", str(table), "--output", str(tmp_path / "out")]) == 0
    noted = [line for line in capsys.readouterr().err.splitlines() if str(table) in line]
    assert [line.endswith("hammer, force_newtons") for line in noted] == [True]
