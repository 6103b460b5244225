"""The .glb is read back by hand and the Faust program is compiled: both sound as the field."""

import csv
import json
import re
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from avmsf.errors import ExportError
from avmsf.export.faust import contacts_path, faust_library, write_faust
from avmsf.export.gltf import write_gltf
from avmsf.export.sampled_field import SampledField
from avmsf.gaussians.ply import write_splats
from avmsf.mesh.surface import Surface
from avmsf.modal.modes import ForcePulse
from factories.clouds import random_cloud
from factories.made_tables import MODES, POINTS, RATE, SAMPLES, apart, summed, table
from factories.raising import raises

KINDS = {5126: "<f4", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3}


def read(path: Path) -> tuple[dict, list[np.ndarray]]:
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    document, data, arrays = json.loads(content[20 : 20 + size]), content[28 + size :], []
    assert struct.unpack_from("<I4s", content, 20 + size) == (len(data), b"BIN\0")
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * WIDTHS[accessor["type"]]
        layout = np.dtype(KINDS[accessor["componentType"]])
        assert view["byteLength"] == count * layout.itemsize
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(data, layout, count, view["byteOffset"])
        arrays.append(values.reshape(-1, 3) if accessor["type"] == "VEC3" else values)
    return document, arrays


def modal(document: dict, arrays: list[np.ndarray]) -> dict[str, np.ndarray]:
    node = document["nodes"][0]["extensions"]["KHR_audio_rigid_bodies"]["modalModel"]
    model = document["extensions"]["KHR_audio_rigid_bodies"]["modalModels"][node]
    return {name: arrays[model[name]] for name in ("frequencies", "decayRates", "positions", "shapes")}


def struck(model: dict[str, np.ndarray], point: int, impulse: np.ndarray) -> np.ndarray:
    """Return the draft's sound of an impulse: mode-major shapes, 2 pi f of the radiation."""
    points = len(model["positions"])
    amplitudes = [
        2 * np.pi * float(f) * float(model["shapes"][m * points + point].astype(float) @ impulse)
        for m, f in enumerate(model["frequencies"])
    ]
    return summed(amplitudes, model["frequencies"], model["decayRates"])


@pytest.mark.parametrize("force", [1.0, 3.0])
def test_an_impulse_into_the_surface_sounds_as_the_blow(tmp_path, force):
    field = table()
    written = write_gltf(field, tmp_path / "thing.glb")
    model = modal(*read(tmp_path / "thing.glb"))
    for point in range(POINTS):
        heard = struck(model, point, -force * field.normals[point].double().numpy())
        true = field.render(torch.tensor([point]), force=force)[0]
        # Frequencies are float32 there: 3300 Hz to 1e-4 Hz, which is a phase of 1e-4 after .2 s.
        assert apart(heard, true) < 3e-4
    assert written.error < 1e-6
    assert written.size == (tmp_path / "thing.glb").stat().st_size
    # A glancing impulse is fainter by its cosine.
    normal = field.normals[2].double().numpy()
    along = np.cross(normal, [0.3, 0.5, -0.2])
    assert apart(struck(model, 2, along - 0.5 * normal), 0.5 * struck(model, 2, -normal)) < 1e-5
    # The modes of most energy come first.
    shapes = model["shapes"].reshape(MODES, POINTS, 3).astype(float)
    gains = np.linalg.norm(shapes, axis=2) * 2 * np.pi * model["frequencies"][:, None]
    assert (np.diff((gains**2).sum(1) / model["decayRates"]) < 0).all()


def test_what_the_draft_cannot_hold_is_said(tmp_path):
    field = table(phased=True, spatial=True, noisy=True, background_force=3.0)
    written = write_gltf(field, tmp_path / "thing.glb")
    words = " ".join(written.remarks)
    assert "starts as a sine" in words
    assert "one damping" in words
    assert "noise" in words
    document, arrays = read(tmp_path / "thing.glb")
    model = modal(document, arrays)
    plain = [struck(model, row, -field.normals[row].double().numpy()) for row in field.spread(8).tolist()]
    true = field.render(field.spread(8)).double().numpy()
    assert written.error == pytest.approx(apart(plain, true), rel=0.01)
    # As loud as it was: every mode's amplitude is that of its sine and cosine together.
    size = np.linalg.norm(model["shapes"].reshape(MODES, POINTS, 3).astype(float), axis=2)
    size *= 2 * np.pi * model["frequencies"][:, None]
    expected = np.sort(field.gains.abs().numpy().T, axis=0)
    np.testing.assert_allclose(np.sort(size, axis=0), expected, rtol=1e-5)


def test_phases_alone_change_the_waveform_and_hardly_the_spectrum(tmp_path):
    # Modes far apart in frequency: a window of 40 ms tells them from one another.
    field = replace(table(phased=True), frequency=torch.tensor([412.3, 1077.7, 2081.25, 3300.1], dtype=torch.float64))
    turned = replace(field, gains=torch.complex(0.1 * field.gains.imag, field.gains.imag))
    written = write_gltf(turned, tmp_path / "thing.glb")
    assert written.error > 0.7
    assert 0.0 < written.spectrum_error_db < 0.7
    # A table without phases is written as it is.
    assert write_gltf(table(), tmp_path / "plain.glb").spectrum_error_db < 1e-4


def test_viewers_show_the_mesh_or_the_points(tmp_path):
    box = trimesh.creation.box((0.2, 0.1, 0.3))
    box.visual.vertex_colors = np.tile([255, 0, 0, 255], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "box.ply")
    field = replace(table(), points=0.2 * table().points)
    write_gltf(field, tmp_path / "mesh.glb", object=tmp_path / "box.ply")
    shown = trimesh.load(tmp_path / "mesh.glb", process=False).dump()[0]
    assert len(shown.faces) == 12
    assert shown.volume == pytest.approx(0.2 * 0.1 * 0.3, rel=1e-5)
    document, arrays = read(tmp_path / "mesh.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert arrays[attributes["COLOR_0"]].tolist()[0] == [1.0, 0.0, 0.0]
    assert len(arrays[attributes["POSITION"]]) == 24
    np.testing.assert_allclose(np.linalg.norm(arrays[attributes["NORMAL"]], axis=1), 1.0, atol=1e-6)
    assert (np.einsum("ij,ij->i", arrays[attributes["NORMAL"]], arrays[attributes["POSITION"]]) > 0).all()
    bounds = document["accessors"][attributes["POSITION"]]
    np.testing.assert_allclose([bounds["min"], bounds["max"]], [[-0.1, -0.05, -0.15], [0.1, 0.05, 0.15]], atol=1e-7)
    assert "extensionsRequired" not in document
    assert document["extensionsUsed"] == ["KHR_audio_rigid_bodies"]
    write_gltf(field, tmp_path / "points.glb")
    (cloud,) = trimesh.load(tmp_path / "points.glb", process=False).geometry.values()
    np.testing.assert_allclose(cloud.vertices, field.points.numpy(), atol=1e-7)


def test_gaussians_are_shown_by_their_centers_and_lie_beside_the_file(tmp_path):
    cloud = random_cloud(table().points)
    write_splats(cloud, tmp_path / "thing.ply")
    written = write_gltf(table(), tmp_path / "a.glb", object=tmp_path / "thing.ply")
    (shown,) = trimesh.load(tmp_path / "a.glb", process=False).geometry.values()
    np.testing.assert_allclose(shown.vertices, cloud.centers, atol=1e-7)
    assert len(np.unique(np.asarray(shown.colors), axis=0)) == POINTS
    assert set(written.sizes) == {tmp_path / "a.glb", tmp_path / "a.gaussians.ply"}
    assert (tmp_path / "a.gaussians.ply").read_bytes() == (tmp_path / "thing.ply").read_bytes()


@pytest.mark.parametrize(("words", "axis"), [({}, 2), ({"up": "x"}, 0), ({"up": "y"}, 1), ({"up": "z"}, 2)])
def test_the_objects_axis_points_up_and_coordinates_stay_in_its_frame(tmp_path, words, axis):
    box = trimesh.creation.box((0.6, 0.6, 0.6))
    box.apply_translation(np.eye(3)[axis])
    surface = Surface.of(np.array(box.vertices), np.array(box.faces))
    field = replace(table(), points=table().points + surface.vertices.mean(0))
    write_gltf(field, tmp_path / "a.glb", object=surface, **words)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    shown = scene.dump()[0]
    np.testing.assert_allclose(shown.centroid, [0.0, 1.0, 0.0], atol=1e-6)
    assert shown.volume == pytest.approx(0.6**3, rel=1e-4)
    (stored,) = scene.geometry.values()
    np.testing.assert_allclose(stored.centroid, np.eye(3)[axis], atol=1e-6)
    np.testing.assert_array_equal(modal(*read(tmp_path / "a.glb"))["positions"], field.points.numpy())


def test_a_texture_becomes_the_corners_colors(tmp_path):
    picture = np.zeros((2, 2, 3), dtype=np.uint8)
    picture[0, 0, 1] = 255  # the upper left is green, all else black
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
    visual = trimesh.visual.TextureVisuals([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]], material=material)
    triangle = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    trimesh.Trimesh(triangle, [[0, 1, 2]], visual=visual, process=False).export(tmp_path / "thing.glb")
    write_gltf(table(), tmp_path / "shown.glb", object=str(tmp_path / "thing.glb"))
    document, arrays = read(tmp_path / "shown.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    places, colors = arrays[attributes["POSITION"]], arrays[attributes["COLOR_0"]]
    assert colors[places[:, 1] == 1].tolist() == [[0.0, 1.0, 0.0]]
    assert colors.sum() == 1.0


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


def rendered(field: SampledField, row: int, **settings: object) -> np.ndarray:
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
        assert apart(heard, rendered(field, 4, force=force)) < 2e-6
    if background_force is not None:
        assert 'hslider("force", 30, 0, 3000, 0.03)' in (tmp_path / "thing.dsp").read_text()


@compiled
def test_blows_ring_into_each_other_each_with_its_hammer(tmp_path):
    field = table(phased=True)
    write_faust(field, tmp_path / "thing.dsp")
    later, soft = 5 * BLOCK, 0.0017
    heard = sounded(tmp_path / "thing.dsp", (0, 1.0, 0.0, 0), (POINTS - 1, 2.0, soft, later))
    true = rendered(field, 0)
    true[later:] += rendered(field, POINTS - 1, force=2.0, pulse=ForcePulse(soft))[: SAMPLES - later]
    assert apart(heard, true) < 2e-6
    # In single precision, as Faust compiles unless told otherwise, no drift shows.
    single = sounded(tmp_path / "thing.dsp", (0, 1.0, 0.0, 0), (POINTS - 1, 2.0, soft, later), real="float")
    assert apart(single, true) < 2e-4


@compiled
def test_another_sample_rate_changes_neither_pitch_nor_decay(tmp_path):
    field = table()
    write_faust(field, tmp_path / "thing.dsp")
    twice = sounded(tmp_path / "thing.dsp", (3, 1.0, 0.0, 0), rate=2 * RATE, samples=2 * SAMPLES)
    assert apart(twice[::2], rendered(field, 3)) < 2e-6
    # At 6 kHz the mode at 3300 Hz would alias to 2700 Hz, and is silent.
    lower = sounded(tmp_path / "thing.dsp", (3, 1.0, 0.0, 0), rate=6000, samples=1200)
    gains = field.gains.clone()
    gains[:, 3] = 0
    silent = replace(field, gains=gains, noise=torch.zeros(1200), sample_rate=6000.0)
    assert apart(lower, rendered(silent, 3)) < 2e-6


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
    assert apart(sounded(tmp_path / "mine.dsp", (0, 1.0, 0.0, 0)), rendered(field, 6)) < 2e-6


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


def test_the_table_has_each_contacts_place(tmp_path):
    field = table()
    # Endings may be in capitals.
    path = tmp_path / "THING.DSP"
    written = write_faust(field, path)
    place = contacts_path(path)
    assert set(written.sizes) == {path, place}
    with place.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["contact"]) for row in rows] == list(range(POINTS))
    assert torch.equal(torch.tensor([[float(row[axis]) for axis in "xyz"] for row in rows]), field.points)
