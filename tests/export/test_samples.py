"""A sampler's grid: every wav is the blow that its row of the table says."""

import csv
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.errors import ExportError
from avmsf.export.samples import Layer, hertz_layers, write_grid
from avmsf.modal.modes import ForcePulse
from factories.made_tables import RATE, SAMPLES, apart, table
from factories.raising import raises

LAYERS = (Layer(0.25, 0.002), Layer(1.0, 0.0005), Layer(3.0))


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "samples.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_row_is_its_blow(tmp_path):
    field = table(phased=True, noisy=True)
    write_grid(field, tmp_path / "grid", contacts=5, layers=LAYERS, level_db=-3.0)
    found = rows(tmp_path / "grid")
    assert len(found) == 15
    assert Counter(row["midi_note"] for row in found) == {str(note): 3 for note in range(36, 41)}
    assert len({(row["x"], row["y"], row["z"]) for row in found}) == 5
    # A sound holds no time of writing, so that equal sounds are equal files.
    content = (tmp_path / "grid" / "sounds" / "001-1.wav").read_bytes()
    assert content[content.index(b"PEAK") + 12 :][:4] == bytes(4)
    truths, sounds = [], []
    for row in found:
        sound, rate = soundfile.read(tmp_path / "grid" / row["file"])
        place = torch.tensor([[float(row[axis]) for axis in "xyz"]])
        point = field.nearest(place)
        assert float((field.points[point] - place).abs().max()) < 1e-6
        assert int(row["contact"]) == int(point)
        assert [float(row[axis]) for axis in ("nx", "ny", "nz")] == pytest.approx(field.normals[point][0].tolist())
        pulse = ForcePulse(float(row["contact_time"]))
        truths.append(field.render(point, force=float(row["force"]), pulse=pulse)[0].numpy())
        sounds.append(sound)
        assert (rate, len(sound), float(row["seconds"])) == (RATE, SAMPLES, SAMPLES / RATE)
        assert float(row["peak_db"]) == pytest.approx(20 * np.log10(np.abs(sound).max()), abs=0.01)
    loudest = max(np.abs(each).max() for each in truths)
    assert apart(sounds, 10 ** (-3 / 20) / loudest * np.array(truths)) < 1e-6


def test_a_layer_of_twice_the_force_has_twice_the_modes_and_the_same_background(tmp_path):
    field = table(noisy=True, background_force=3.0)
    write_grid(field, tmp_path / "grid", contacts=1, layers=(Layer(1.0), Layer(2.0)))
    soft, hard = (soundfile.read(tmp_path / "grid" / row["file"])[0] for row in rows(tmp_path / "grid"))
    scale = json.loads((tmp_path / "grid" / "manifest.json").read_text())["scale"]
    assert apart(2 * soft - hard, scale * 3.0 * field.noise.numpy()) < 1e-5
    # Unless a force is given, it is that of the recordings on average.
    write_grid(field, tmp_path / "one", contacts=1)
    assert [float(row["force"]) for row in rows(tmp_path / "one")] == [3.0]


def test_the_instrument_plays_every_file_at_its_key(tmp_path):
    write_grid(table(), tmp_path / "grid", contacts=4, layers=LAYERS)
    regions = played(tmp_path / "grid")
    expected = [(r["file"], r["midi_note"], r["velocity_low"], r["velocity_high"]) for r in rows(tmp_path / "grid")]
    assert sorted((r["sample"], r["key"], r["lovel"], r["hivel"]) for r in regions) == sorted(expected)
    assert all((tmp_path / "grid" / region["sample"]).is_file() for region in regions)


def played(folder: Path) -> list[dict[str, str]]:
    """Return the instrument's regions, each with what it takes over from its group."""
    regions, group = [], {}
    for header, rest in re.findall(r"<(\w+)> (.*)", (folder / "instrument.sfz").read_text()):
        opcodes = dict(word.split("=") for word in rest.split())
        if header == "group":
            group = opcodes
        elif header == "region":
            regions.append(group | opcodes)
    return regions


def levels(folder: Path, note: int) -> np.ndarray:
    """Return the root mean square amplitude that the instrument plays at each velocity, 1 to 127."""
    found = np.full(128, np.nan)
    for region in (each for each in played(folder) if int(each["key"]) == note):
        sound = np.sqrt(np.mean(soundfile.read(folder / region["sample"])[0] ** 2))
        for velocity in range(int(region["lovel"]), int(region["hivel"]) + 1):
            gain = float(region[f"amp_velcurve_{velocity}"])
            assert 0 <= gain <= 1 + 1e-6
            found[velocity] = gain * sound
    return found[1:]


@pytest.mark.parametrize("layers", [LAYERS, (Layer(0.5), Layer(1.0), Layer(2.0)), (Layer(2.0), Layer(1.0))])
def test_the_level_rises_with_the_velocity_without_steps_between_layers(tmp_path, layers):
    write_grid(table(), tmp_path / "grid", contacts=2, layers=layers)
    write_grid(table(), tmp_path / "one", contacts=2)
    assert float(played(tmp_path / "one")[0]["amp_velcurve_64"]) == pytest.approx((64 / 127) ** 2, rel=1e-5)
    for note in (36, 37):
        level = levels(tmp_path / "grid", note)
        assert (np.diff(level) >= -1e-6 * level[-1]).all()
        # Half a decibel, where it takes the velocity's square 9.5 dB to fall from 3 to 1.
        assert (20 * np.log10(level[42:] / level[41:-1]) < 0.5).all()


def test_layers_go_from_soft_to_loud_whatever_their_order(tmp_path):
    for name, layers, order in (
        ("forces", (Layer(2.0), Layer(1.0), Layer(0.5)), [2, 1, 0]),
        ("times", (Layer(1.0), Layer(1.0, 0.002), Layer(1.0, 0.0005)), [1, 2, 0]),
    ):
        write_grid(table(), tmp_path / name, contacts=2, layers=layers)
        found = [(float(row["force"]), float(row["contact_time"])) for row in rows(tmp_path / name)[:3]]
        assert found == [(layers[number].force, layers[number].contact_time) for number in order]


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        ({"contacts": 0}, "contacts", 0),
        ({"contacts": 93}, "contacts", 93),
        ({"layers": ()}, "layers", 0),
        ({"layers": (Layer(-1.0),)}, "force", -1.0),
        ({"layers": (Layer(1.0, contact_time=2.0),)}, "contact_time", 2.0),
        ({"seconds": 0.0}, "seconds", 0.0),
        ({"range_db": -1.0}, "range_db", -1.0),
        ({"level_db": 6.0}, "level_db", 6.0),
    ],
)
def test_bad_settings_are_refused(tmp_path, settings, name, value):
    with raises(ExportError, name=name, value=value):
        write_grid(table(), tmp_path / "grid", **settings)
    assert not (tmp_path / "grid").exists()
    with raises(ExportError, name="sample_rate", value=8000.5):
        write_grid(replace(table(), sample_rate=8000.5), tmp_path / "grid")


def test_a_harder_impact_is_shorter_in_contact_by_hertzs_law():
    """The squares of the pulses' widths add: recorded and added one make up the contact time, as force^(-1/6)."""
    layers = hertz_layers((0.3, 3.0, 1.0))
    assert [layer.force for layer in layers] == [0.3, 3.0, 1.0]
    assert layers[1].contact_time == 0.0
    widths = [1 + (layer.contact_time / layers[0].contact_time) ** 2 * (10 ** (1 / 3) - 1) for layer in layers]
    assert widths == pytest.approx([(3.0 / force) ** (1 / 3) for force in (0.3, 3.0, 1.0)])
