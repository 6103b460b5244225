"""The Faust program is compiled by Faust and a C compiler, and sounds as the field."""

import csv
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.errors import ExportError
from avmsf.export.faust import contacts_path, faust_library, write_faust
from avmsf.export.sampled_field import SampledField
from avmsf.modal.modes import ForcePulse
from factories.made_tables import MODES, POINTS, RATE, SAMPLES, apart, table
from factories.raising import raises

DRIVER = Path(__file__).with_name("faust_driver.c")
BLOCK = 64
compiled = pytest.mark.skipif(
    shutil.which("faust") is None or shutil.which("gcc") is None, reason="needs Debian's faust and gcc"
)


def sounded(
    path: Path, *blows: tuple[float, float, float, int], rate=RATE, samples=SAMPLES, real="double"
) -> np.ndarray:
    """Return the program's sound of blows: contact, force, contact time, and a start at a block's beginning."""
    source, program = path.with_suffix(".c"), path.with_suffix(".run")
    precision = "-double" if real == "double" else "-single"
    subprocess.run(
        ["faust", "-lang", "c", precision, "-a", str(DRIVER), "-o", str(source), str(path)], check=True, timeout=60
    )
    subprocess.run(["gcc", "-O1", "-w", f"-DREAL={real}", "-o", str(program), str(source), "-lm"], check=True)
    words = [str(value) for blow in blows for value in blow]
    printed = subprocess.run([str(program), f"{rate:.0f}", str(samples), *words], check=True, capture_output=True)
    return np.frombuffer(printed.stdout)


def struck(field: SampledField, row: int, **settings: object) -> np.ndarray:
    return field.render(torch.tensor([row]), **settings)[0].double().numpy()


@compiled
@pytest.mark.parametrize(
    ("phased", "spatial", "noisy", "background_force"),
    [(False, False, False, None), (True, False, True, None), (True, True, True, 30.0)],
)
def test_every_kind_of_field_sounds_as_rendered(tmp_path, phased, spatial, noisy, background_force):
    field = table(phased=phased, spatial=spatial, noisy=noisy, background_force=background_force)
    write_faust(field, tmp_path / "thing.dsp")
    for force in (0.5, 1.0):
        heard = sounded(tmp_path / "thing.dsp", (4, force, 0.0, 0))
        assert apart(heard, struck(field, 4, force=force)) < 2e-6
    if background_force is not None:
        assert 'hslider("force", 30, 0, 3000, 0.03)' in (tmp_path / "thing.dsp").read_text()


@compiled
def test_blows_ring_into_each_other_each_with_its_hammer(tmp_path):
    field = table(phased=True)
    write_faust(field, tmp_path / "thing.dsp")
    later, soft = 5 * BLOCK, 0.0017
    heard = sounded(tmp_path / "thing.dsp", (0, 1.0, 0.0, 0), (POINTS - 1, 2.0, soft, later))
    true = struck(field, 0)
    true[later:] += struck(field, POINTS - 1, force=2.0, pulse=ForcePulse(soft))[: SAMPLES - later]
    assert apart(heard, true) < 2e-6
    # In single precision, as Faust compiles unless told otherwise, no drift shows.
    single = sounded(tmp_path / "thing.dsp", (0, 1.0, 0.0, 0), (POINTS - 1, 2.0, soft, later), real="float")
    assert apart(single, true) < 2e-4


@compiled
def test_another_sample_rate_changes_neither_pitch_nor_decay(tmp_path):
    field = table()
    write_faust(field, tmp_path / "thing.dsp")
    twice = sounded(tmp_path / "thing.dsp", (3, 1.0, 0.0, 0), rate=2 * RATE, samples=2 * SAMPLES)
    assert apart(twice[::2], struck(field, 3)) < 2e-6
    # At 6 kHz the mode at 3300 Hz would alias to 2700 Hz, and is silent.
    lower = sounded(tmp_path / "thing.dsp", (3, 1.0, 0.0, 0), rate=6000, samples=1200)
    gains = field.gains.clone()
    gains[:, 3] = 0
    silent = replace(field, gains=gains, noise=torch.zeros(1200), sample_rate=6000.0)
    assert apart(lower, struck(silent, 3)) < 2e-6


@compiled
def test_nothing_sounds_before_the_first_impact(tmp_path):
    write_faust(table(noisy=True), tmp_path / "thing.dsp")
    heard = sounded(tmp_path / "thing.dsp", (1, 1.0, 0.0, 3 * BLOCK))
    assert not heard[: 3 * BLOCK].any()
    assert heard[3 * BLOCK :].any()


@compiled
def test_the_library_holds_the_same_sound_without_controls(tmp_path):
    field = table(phased=True)
    write_faust(field, tmp_path / "thing.lib")
    assert "process" not in (tmp_path / "thing.lib").read_text()
    (tmp_path / "mine.dsp").write_text(
        'mine = library("thing.lib");\nprocess = mine.strike(6, 1, 0, button("gate"));\n'
    )
    assert apart(sounded(tmp_path / "mine.dsp", (0, 1.0, 0.0, 0)), struck(field, 6)) < 2e-6


def test_the_name_cannot_break_out_of_its_string():
    named = replace(table(), name='a"; process = _; // \n b\\')
    lines = faust_library(named).splitlines()
    assert lines[1] == 'declare name "a; process = _; //  b";'
    assert not any(re.match(r"\s*process", line) for line in lines)


def test_as_many_points_are_written_as_faust_compiles_unless_more_are_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr("avmsf.export.faust.MAX_NUMBERS", 20)
    path = tmp_path / "thing.dsp"
    with raises(ExportError, name="numbers", value=POINTS * MODES):
        write_faust(table(), path, contacts=POINTS)
    assert "5 of 9 contacts are written, evenly spread: Faust" in " ".join(write_faust(table(), path).remarks)
    assert "points = 5;" in path.read_text()
    remarks = write_faust(table(), path, contacts=3, overwrite=True).remarks
    assert "3 of 9 contacts are written, evenly spread" in remarks


def test_other_endings_are_refused(tmp_path):
    with raises(ExportError, file="thing.cpp", name="suffix", value=".cpp"):
        write_faust(table(), tmp_path / "thing.cpp")


def test_the_table_has_each_contacts_place(tmp_path):
    field = table()
    path = tmp_path / "thing.dsp"
    written = write_faust(field, path)
    place = contacts_path(path)
    assert set(written.sizes) == {path, place}
    with place.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["contact"]) for row in rows] == list(range(POINTS))
    assert torch.equal(torch.tensor([[float(row[axis]) for axis in "xyz"] for row in rows]), field.points)
