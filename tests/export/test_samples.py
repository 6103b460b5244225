"""The paper's demo and a sampler's grid: bytes and sounds lie where manifests and tables say."""

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
from avmsf.export.paper_demo import write_demo
from avmsf.export.samples import LEVEL_DB, Layer, hertz_layers, write_grid
from avmsf.gaussians.ply import read_splats
from avmsf.modal.modes import ForcePulse
from factories.clouds import random_cloud
from factories.made_tables import MODES, POINTS, RATE, SAMPLES, apart, read_arrays, summed, table
from factories.raising import raises

LAYERS = (Layer(0.25, 0.002), Layer(1.0, 0.0005), Layer(3.0))


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "samples.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_row_is_its_blow(tmp_path):
    field = table(phased=True, noisy=True, points=5)
    write_grid(field, tmp_path / "grid", layers=LAYERS)
    found = rows(tmp_path / "grid")
    assert len(found) == 15
    assert Counter(row["midi_note"] for row in found) == {str(note): 3 for note in range(36, 41)}
    assert len({(row["x"], row["y"], row["z"]) for row in found}) == 5
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
    assert apart(sounds, 10 ** (LEVEL_DB / 20) / loudest * np.array(truths)) < 1e-6


def test_a_layer_of_twice_the_force_has_twice_the_modes_and_the_same_background(tmp_path):
    field = table(noisy=True, background_force=3.0, points=1)
    write_grid(field, tmp_path / "grid", layers=(Layer(1.0), Layer(2.0)))
    soft, hard = (soundfile.read(tmp_path / "grid" / row["file"])[0] for row in rows(tmp_path / "grid"))
    scale = json.loads((tmp_path / "grid" / "manifest.json").read_text())["scale"]
    assert apart(2 * soft - hard, scale * 3.0 * field.noise.numpy()) < 1e-5
    # Unless a force is given, it is that of the recordings on average.
    write_grid(field, tmp_path / "one")
    assert [float(row["force"]) for row in rows(tmp_path / "one")] == [3.0]


def test_the_instrument_plays_every_file_at_its_key(tmp_path):
    write_grid(table(points=4), tmp_path / "grid", layers=LAYERS)
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
    field = table().take(table().spread(2))
    write_grid(field, tmp_path / "grid", layers=layers)
    write_grid(field, tmp_path / "one")
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
        write_grid(table(points=2), tmp_path / name, layers=layers)
        found = [(float(row["force"]), float(row["contact_time"])) for row in rows(tmp_path / name)[:3]]
        assert found == [(layers[number].force, layers[number].contact_time) for number in order]


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        ({"layers": ()}, "layers", 0),
        ({"layers": (Layer(-1.0),)}, "force", -1.0),
        ({"layers": (Layer(1.0, contact_time=2.0),)}, "contact_time", 2.0),
        ({"seconds": 0.0}, "seconds", 0.0),
        ({"range_db": -1.0}, "range_db", -1.0),
    ],
)
def test_bad_settings_are_refused(tmp_path, settings, name, value):
    with raises(ExportError, name=name, value=value):
        write_grid(table(), tmp_path / "grid", **settings)
    assert not (tmp_path / "grid").exists()
    with raises(ExportError, name="contacts", value=93):
        write_grid(table(points=93), tmp_path / "grid")
    with raises(ExportError, name="sample_rate", value=8000.5):
        write_grid(replace(table(), sample_rate=8000.5), tmp_path / "grid")


def test_a_harder_impact_is_shorter_in_contact_by_hertzs_law():
    """The squares of the pulses' widths add: recorded and added one make up the contact time, as force^(-1/6)."""
    layers = hertz_layers((0.3, 3.0, 1.0))
    assert [layer.force for layer in layers] == [0.3, 3.0, 1.0]
    assert layers[1].contact_time == 0.0
    widths = [1 + (layer.contact_time / layers[0].contact_time) ** 2 * (10 ** (1 / 3) - 1) for layer in layers]
    assert widths == pytest.approx([(3.0 / force) ** (1 / 3) for force in (0.3, 3.0, 1.0)])


def test_layers_beneath_the_background_are_noted(tmp_path):
    field = table(noisy=True, background_force=100.0)
    for force in (0.5, 100.0):
        written = write_grid(field, tmp_path / f"{force}", layers=[Layer(force)])
        assert any("background" in remark for remark in written.remarks) == (force == 0.5)


def cosines(**settings):
    """Return a table whose modes start as the demo's do."""
    field = table(**settings)
    return replace(field, gains=1j * field.gains)


@pytest.mark.parametrize("spatial", [False, True])
def test_the_bytes_lie_where_the_manifests_say(tmp_path, spatial):
    field, demo = cosines(spatial=spatial), tmp_path / "demo"
    report = write_demo(field, demo)
    sound, picked = read_arrays(demo / "original"), read_arrays(demo)
    for row in range(POINTS):
        damping = sound["dampings"][row] if spatial else sound["dampings"]
        heard = summed(1j * sound["gains"][row].numpy(), sound["frequencies"].numpy(), damping.numpy())
        assert apart(heard, field.render(torch.tensor([row]))[0]) < 3e-4
    assert report.error < 1e-6
    manifest = json.loads((demo / "original" / "manifest.json").read_text())
    assert (manifest["duration"], manifest["sampleRate"], manifest["modes"]) == (SAMPLES / RATE, RATE, MODES)
    assert json.loads((demo / "manifest.json").read_text())["count"] == POINTS
    assert torch.equal(picked["means"], field.points)
    assert (demo / "picking.bin").stat().st_size == 4 * POINTS * (3 + 3 + 4 + 1)


def test_modes_that_start_otherwise_keep_their_loudness_and_their_nodes(tmp_path):
    field = table(phased=True, noisy=True)
    # One mode has the same phase everywhere: the signs that it has along the surface must stay.
    field.gains[:, 1] = (1 + 0.7j) * torch.linspace(-1, 1, POINTS)
    report = write_demo(field, tmp_path / "demo")
    gains = read_arrays(tmp_path / "demo" / "original")["gains"]
    torch.testing.assert_close(gains.abs(), field.gains.abs())
    signs = gains[:, 1].sign() * field.gains[:, 1].real.sign()
    assert len(set(signs[field.gains[:, 1] != 0].tolist())) == 1
    assert report.error > 0.1
    words = " ".join(report.remarks)
    assert "cosine" in words
    assert "noise" in words


def test_the_gaussians_are_those_given_or_discs_on_the_surface(tmp_path):
    field = cosines()
    write_demo(field, tmp_path / "discs")
    cloud = read_splats(tmp_path / "discs" / "scene.ply")
    demo = read_arrays(tmp_path / "discs")
    torch.testing.assert_close(cloud.centers, field.points)
    torch.testing.assert_close(demo["scales"], cloud.log_scales.exp())
    torch.testing.assert_close(demo["opacities"], cloud.opacities)
    w, x, y, z = demo["quaternions"].double().unbind(1)
    third = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    torch.testing.assert_close(third.float(), field.normals, atol=1e-5, rtol=0)
    given = random_cloud(field.points, degree=1)
    write_demo(field, tmp_path / "given", cloud=given)
    torch.testing.assert_close(read_splats(tmp_path / "given" / "scene.ply").harmonics, given.harmonics)
    with raises(ExportError, name="cloud", value=3):
        write_demo(field, tmp_path / "few", cloud=given.take(torch.arange(3)))


def test_half_precision_keeps_three_digits_and_what_the_layout_cannot_hold_is_refused(tmp_path):
    field = cosines()
    report = write_demo(field, tmp_path / "demo", precision="float16")
    error = apart(read_arrays(tmp_path / "demo" / "original")["gains"].float(), field.gains.imag)
    assert 1e-6 < error < 2**-11
    assert 1e-6 < report.error < 2**-9
    sizes = {path.name: size for path, size in report.sizes.items() if path.parent.name == "original"}
    assert sizes["modal.bin"] == 4 * MODES + 2 * POINTS * MODES + 4 * MODES
    with raises(ExportError, name="variant", value="../wood"):
        write_demo(field, tmp_path / "other", variant="../wood")
    field.gains[0, 0] = 1e6j
    with raises(ExportError, name="precision", value=1e6), np.errstate(over="ignore"):
        write_demo(field, tmp_path / "loud", precision="float16")
