"""`avmsf render`: noise, and what it says of a table."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main
from avmsf.cli.contacts import read_contacts
from avmsf.field.soundfield import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.residual import Residual
from made_fields import BANK, positional

AT = ("--position", "0.05", "0.03", "0.002")
PLACE = torch.tensor([[0.05, 0.03, 0.002]], dtype=torch.float64)
Streams = pytest.CaptureFixture[str]


def sounding() -> SoundField:
    phase = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, positional(), phase, Residual(torch.full((9,), 0.01)), 8000.0, 2000, Origin("plate"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save(sounding(), tmp_path / "plate.safetensors")
    return tmp_path / "plate.safetensors"


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
    assert np.abs(noisy - modes - sounding().noise().numpy()).max() < 1e-6
    assert words or np.array_equal(modes, sounding().render(PLACE, noise=False)[0].numpy())


def test_columns_that_are_not_used_are_named(path: Path, tmp_path: Path, capsys: Streams) -> None:
    table = tmp_path / "places.csv"
    table.write_text("File,x,y,z,nz,Hammer,force_newtons\na,0.05,0.03,0.002,1,felt,2\nb,0.02,0.03,0.002,1,felt,2\n")
    assert read_contacts(table, meters=1.0).unused == ("hammer", "force_newtons")
    assert main(["render", str(path), "--contact-table", str(table), "--output", str(tmp_path / "out")]) == 0
    noted = [line for line in capsys.readouterr().err.splitlines() if str(table) in line]
    assert [line.endswith("hammer, force_newtons") for line in noted] == [True]
