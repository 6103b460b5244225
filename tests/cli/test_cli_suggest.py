"""`avmsf suggest`: from a field file to a table, a list and a picture."""

import csv
from pathlib import Path

import pytest

from avmsf.cli.paths import OutputError
from avmsf.errors import FitError
from avmsf.field.store import save
from factories.believing_field import bar_contacts, drawn_gains, elastic_field, sound_field
from factories.raising import raises
from factories.verbs import results_of, run_verb

Streams = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    contacts = bar_contacts(6)
    path = tmp_path_factory.mktemp("fields") / "bar.safetensors"
    save(sound_field(elastic_field(contacts, drawn_gains(contacts, seed=1))), path)
    return path


def test_the_list_to_walk_by_is_what_is_printed(field: Path, tmp_path: Path, capsys: Streams) -> None:
    printed, _ = results_of(capsys, "suggest", field, "--count", "3", "--plots", tmp_path / "next")
    with open(tmp_path / "next" / "suggested.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["order"] for row in rows] == ["1", "2", "3"]
    for row, known in zip(rows, printed["suggestions"], strict=True):
        for name in ("x", "y", "z", "nx", "ny", "nz", "error_after"):
            assert float(row[name]) == pytest.approx(known[name], rel=1e-5, abs=1e-9)
    errors = [printed["error_before"], *(each["error_after"] for each in printed["suggestions"])]
    assert errors == sorted(errors, reverse=True)
    assert (tmp_path / "next" / "suggested.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_done_is_said_before_any_work(field: Path, tmp_path: Path) -> None:
    with raises(FitError, name="count", value=0):
        run_verb("suggest", str(field), "--count", "0")
    settings = tmp_path / "capture.toml"
    settings.write_text("")
    with raises(FitError, name="--settings"):
        run_verb("suggest", str(field), "--settings", str(settings))
    blocked = tmp_path / "file"
    blocked.write_text("")
    with raises(OutputError, file=blocked, value="file"):
        run_verb("suggest", str(field), "--output", str(blocked))
    with raises(FitError, name="--unseen"):
        run_verb("suggest", str(field), "--unseen", "--candidates", str(tmp_path))
