"""`avmsf render` along the directions of impacts."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import main
from factories.made_fields import directional, saved, sounding

PLACES = torch.tensor([[0.05, 0.03, 0.002], [0.05, 0.03, 0.002], [-0.04, 0.01, 0.002]], dtype=torch.float64)
DIRECTIONS = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return saved(directional(), tmp_path)


def test_directions_of_a_table_are_rendered(path: Path, tmp_path: Path) -> None:
    rows = [
        f"{number}.wav,{','.join(map(str, place))},{','.join(map(str, way)) if any(way) else ',,'}"
        for number, (place, way) in enumerate(zip(PLACES.tolist(), DIRECTIONS.tolist(), strict=True))
    ]
    (tmp_path / "impacts.csv").write_text("\n".join(["file,x,y,z,nx,ny,nz", *rows]) + "\n")
    table = ("--contact-table", str(tmp_path / "impacts.csv"))
    assert main(["render", str(path), *table, "--output", str(tmp_path / "all")]) == 0
    expected = sounding(directional()).render(PLACES, directions=DIRECTIONS)
    for number, sound in enumerate(expected):
        found = soundfile.read(tmp_path / "all" / f"{number}.wav", dtype="float32")[0]
        assert np.array_equal(found, sound.numpy())
    assert not torch.equal(expected[0], expected[1])


def test_the_direction_of_a_contact_is_rendered(path: Path, tmp_path: Path) -> None:
    words = ["--position", "0.05", "0.03", "0.002", "--direction", "0", "0", "1", "--output", str(tmp_path / "up.wav")]
    assert main(["render", str(path), *words]) == 0
    expected = sounding(directional()).render(PLACES[1:2], directions=DIRECTIONS[1:2])[0]
    assert np.array_equal(soundfile.read(tmp_path / "up.wav", dtype="float32")[0], expected.numpy())


def test_directions_and_contacts_are_as_many(path: Path, tmp_path: Path) -> None:
    words = ["--position", "0.05", "0.03", "0.002", *(["--direction", "0", "0", "1"] * 2)]
    assert main(["render", str(path), *words, "--output", str(tmp_path / "up.wav")]) == 2
    assert not (tmp_path / "up.wav").exists()
