"""`avmsf export`: every format from a field file, what it says, and what it refuses."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.editing.material import change_material
from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import AvmsfError
from avmsf.export.sampled_field import SampledField
from avmsf.field.config import FitConfig
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.sound_field import Origin
from avmsf.field.store import load, save
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.modal.modes import ModalBank
from factories.believing_field import ELASTIC, bar, bar_points
from factories.capture_folder import fill
from factories.clouds import random_cloud
from factories.made_fields import BANK, SIDES, directional, elastic, positional, saved, sounding
from factories.made_tables import read_arrays
from factories.raising import raises
from factories.verbs import Streams, run_verb

SAMPLES = 1200
# Meshes here have no colors.
pytestmark = pytest.mark.filterwarnings("ignore::avmsf.errors.CaptureWarning")


@pytest.fixture(scope="module")
def field_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("field") / "plate.safetensors"
    phase, origin = torch.linspace(0, 0.5, len(BANK)), Origin("plate", config=FitConfig(seed=1))
    save(sounding(positional(), phase=phase, noise=1e-3, samples=SAMPLES, origin=origin), path)
    return path


def export(field: Path, to: str, output: Path, *words: object) -> Path:
    """Export a field; raises the verb's errors."""
    assert run_verb("export", str(field), "--to", to, "--output", str(output), *map(str, words)) == 0
    return output


def box(path: Path, factor: float = 1.0) -> Path:
    """Write the field's plate as a mesh, its coordinates times a factor."""
    path.parent.mkdir(exist_ok=True)
    trimesh.creation.box([factor * side for side in SIDES]).export(path)
    return path


def shown_in(output: Path) -> Any:
    """Return the mesh in a .glb, or in a page's folder."""
    return trimesh.load(output / "object.glb" if output.is_dir() else output, process=False).dump()[0]


def table_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def gaussians(path: Path) -> GaussianCloud:
    cloud = random_cloud(positional().points[:40])
    write_splats(cloud, path)
    return cloud


def test_without_noise_none_is_written(field_file: Path, tmp_path: Path) -> None:
    for words, noisy in (([], True), (["--no-noise"], False)):
        faust = export(field_file, "faust", tmp_path / f"{noisy}.dsp", "--contacts", 3, *words).read_text()
        assert ("noiseDraw" in faust) == noisy
        page = export(field_file, "web", tmp_path / f"page {noisy}", *words)
        where = json.loads((page / "manifest.json").read_text())["tensors"]["noise"]
        noise = np.fromfile(page / "field.bin", "<f4", where["shape"][0], offset=where["offset"])
        assert bool(noise.any()) == noisy


def test_contacts_of_faust_and_of_wavs_have_the_same_numbers(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    export(field_file, "faust", tmp_path / "a.dsp", "--contacts", 7, "--json")
    contacts = Path(json.loads(capsys.readouterr().out)["contacts"])
    folder = export(field_file, "wavs", tmp_path / "w", "--contacts", 7, "--seconds", 0.01)
    tables = (table_of(path) for path in (contacts, folder / "samples.csv"))
    one, other = ({row["contact"]: [row[axis] for axis in "xyz"] for row in table} for table in tables)
    assert len(one) == 7
    assert one == other


def test_the_demo_has_the_given_gaussians_or_so_many_of_them(field_file: Path, tmp_path: Path) -> None:
    cloud, found = gaussians(tmp_path / "plate.ply"), {}
    for name, words in (("original", ()), ("glass", ("--contacts", 11, "--variant", "glass"))):
        demo = export(field_file, "avmsf-demo", tmp_path / name, "--object", tmp_path / "plate.ply", *words)
        found[name] = read_arrays(demo)["means"], read_arrays(demo / name)["gains"]
    (means, gains), (few, few_gains) = found.values()
    assert torch.equal(means, cloud.centers)
    torch.testing.assert_close(gains.abs(), SampledField.of(load(field_file), cloud.centers).gains.abs())
    rows = [int((cloud.centers - point).norm(dim=1).argmin()) for point in few]
    assert len(set(rows)) == 11
    torch.testing.assert_close(few_gains, gains[rows])
    torch.testing.assert_close(read_splats(demo / "scene.ply").harmonics, cloud.harmonics[rows])


def test_wavs_have_the_layers_asked_for(field_file: Path, tmp_path: Path) -> None:
    words = ("--contacts", 2, "--pulse", "hertz", "--forces", 0.5, 2, "--contact-times", 0.001, 0, "--seconds", 0.05)
    folder = export(field_file, "wavs", tmp_path / "w", *words)
    assert json.loads((folder / "manifest.json").read_text())["pulses"] == ["hertz", "hertz"]
    rows = table_of(folder / "samples.csv")
    assert [(row["force"], row["contact_time"]) for row in rows] == [("0.5", "0.001"), ("2", "0")] * 2
    assert soundfile.info(folder / rows[0]["file"]).frames == 400
    mallets = export(field_file, "wavs", tmp_path / "m", "--contacts", 1, "--contact-times", 0.001, 0)
    assert [row["contact_time"] for row in table_of(mallets / "samples.csv")] == ["0.001", "0"]


def test_a_contact_that_is_hardly_heard_is_no_key_unless_it_is_asked_for(field_file, tmp_path, monkeypatch):
    sampled = SampledField.of(load(field_file), limit=5)
    factor = torch.tensor([1.0, 1.0, 1e-3, 1.0, 1.0])[:, None]
    silent = replace(sampled, gains=factor * sampled.gains)
    monkeypatch.setattr(SampledField, "of", lambda *_, **__: silent)
    for given, keys in (((), 4), (("--position", 0, 0, 0), 5)):
        folder = export(field_file, "wavs", tmp_path / str(keys), "--seconds", 0.05, *given)
        assert len(list((folder / "sounds").iterdir())) == keys


WRONG: dict[str, dict[str, Any]] = {
    "wavs s2.wav": {"file": "s2.wav", "name": "suffix", "value": ".wav"},
    "web page.glb": {"file": "page.glb", "name": "suffix", "value": ".glb"},
    "faust a": {"file": "a", "name": "suffix", "value": ""},
    "wavs out --contacts 0": {"name": "--contacts", "value": 0},
    "wavs out --forces 1 2 3 --contact-times 0 0": {"name": "--contact-times", "value": 2},
    "wavs out --position 0.05 0.03 0.002 --contacts 3": {"name": "--position", "value": 2},
    "wavs out --position 50 30 2": {"name": "--position", "value": [50.0, 30.0, 2.0]},
    "gltf a.glb --object none.obj": {"file": "none.obj"},
    "gltf a.glb --object large.stl": {"file": "large.stl", "name": "size"},
    "uff a.uff --functions -1": {"name": "functions", "value": -1},
    "avmsf-demo out --object box.ply": {"file": "box.ply"},
    "faust theirs.dsp --contacts 3": {"file": "theirs.dsp"},
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_exported_is_refused(words, field_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    box(tmp_path / "box.ply")
    box(tmp_path / "large.stl", 1000.0)
    (tmp_path / "theirs.dsp").write_text("theirs")
    before = sorted(tmp_path.iterdir())
    to, output, *others = words.split()
    with raises(AvmsfError, **WRONG[words]):
        export(field_file, to, Path(output), *others)
    assert sorted(tmp_path.iterdir()) == before
    if "theirs" in words:
        export(field_file, to, Path(output), "--overwrite", *others)


def test_a_folder_may_have_a_dot_in_its_name(field_file: Path, tmp_path: Path) -> None:
    (tmp_path / "old.wav").mkdir()
    for name in ("bowl-1.2", "name.github.io", "old.wav"):
        folder = export(field_file, "wavs", tmp_path / name, "--contacts", 1, "--seconds", 0.01)
        assert (folder / "samples.csv").is_file()


GIVEN = ((0.05, 0.03, 0.002), (0.045, 0.03, 0.002), (0.01, 0.07, 0.002))
"""Contacts, meters."""
WAYS = ((0.6, 0.0, -0.8), (0.0, 0.0, 2.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("how", ["options", "table", "directions"])
def test_a_sample_set_has_the_given_contacts_in_their_order(how: str, tmp_path: Path) -> None:
    field, places = saved(directional(), tmp_path), torch.tensor(GIVEN, dtype=torch.float64)
    words: list[object] = [word for place in GIVEN for word in ("--position", *place)]
    ways = WAYS if how == "directions" else ((0.0, 0.0, 0.0),) * 3
    if how != "options":
        cells = [way if any(way) else ("", "", "") for way in ways]
        rows = [[*place, *way] for place, way in zip((1e3 * places).tolist(), cells, strict=True)]
        lines = ["x,y,z,nx,ny,nz", *(",".join(map(str, row)) for row in rows)]
        (tmp_path / "places.csv").write_text("\n".join(lines) + "\n")
        words = ["--contact-table", tmp_path / "places.csv", "--unit", "mm"]
    folder = export(field, "wavs", tmp_path / "set", *words, "--no-noise")
    samples = table_of(folder / "samples.csv")
    np.testing.assert_allclose([[float(row[axis]) for axis in "xyz"] for row in samples], GIVEN, atol=1e-9)
    if how == "directions":
        normals = [[float(row[axis]) for axis in ("nx", "ny", "nz")] for row in samples[:2]]
        expected = -torch.nn.functional.normalize(torch.tensor(ways[:2], dtype=torch.float64))
        np.testing.assert_allclose(normals, expected.numpy(), atol=1e-6)
    scale = json.loads((folder / "manifest.json").read_text())["scale"]
    expected = scale * load(field).render(places, torch.tensor(ways, dtype=torch.float64), noise=False)
    for row, sound in zip(samples, expected, strict=True):
        written = soundfile.read(folder / row["file"], dtype="float32")[0]
        # Both are float32, of a peak below 1.
        np.testing.assert_allclose(written, sound.numpy(), atol=1e-5)


@pytest.mark.parametrize("place", ["capture/.avmsf/surface.ply", "plate-surface.ply", ".avmsf/surface.ply"])
def test_the_surface_made_from_photographs_is_shown(place: str, field_file: Path, tmp_path: Path) -> None:
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"])
    box(tmp_path / place)
    field = (tmp_path / place).parent / "field.safetensors" if place.startswith(".") else tmp_path / "plate.safetensors"
    field.write_bytes(field_file.read_bytes())
    for to, name in (("gltf", "a.glb"), ("web", "page")):
        assert len(shown_in(export(field, to, tmp_path / name, "--capture", tmp_path / "capture")).faces) == 12


@pytest.mark.parametrize(("to", "name"), [("gltf", "a.glb"), ("web", "page")])
def test_the_body_of_the_gains_is_shown_before_a_reconstruction(to: str, name: str, tmp_path: Path) -> None:
    # Points on a closed lid above the body, as a reconstruction from outside has it.
    points = torch.cat([bar_points(), bar_points() + torch.tensor([0.0, 0.0, 0.05])]).float()
    bank = ModalBank(ELASTIC, torch.ones(6, dtype=torch.float64))
    field = sounding(BodyGains(points, bar()), bank=bank, noise=1e-3, samples=SAMPLES)
    save(field, tmp_path / "b.safetensors")
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"])
    box(tmp_path / "capture" / ".avmsf" / "surface.ply")
    output = export(tmp_path / "b.safetensors", to, tmp_path / name, "--capture", tmp_path / "capture")
    assert len(shown_in(output).faces) == len(bar().triangles)
    if to == "web":
        assert json.loads((output / "manifest.json").read_text())["points"] == len(bar_points())


def test_an_edited_field_is_not_paired_with_recordings(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    save(adjust_modes(load(field_file), pitch=2.0), tmp_path / "high.safetensors")
    fill(tmp_path / "capture", rows=["a.wav,0,0,0", "b.wav,0.01,0,0", "c.wav,0.02,0,0"])
    for field, count in ((field_file, 3), (tmp_path / "high.safetensors", 0)):
        page = export(field, "web", tmp_path / field.stem, "--capture", tmp_path / "capture")
        assert len(json.loads((page / "manifest.json").read_text())["strikes"]) == count
        assert ("field is edited" in capsys.readouterr().err) == (count == 0)


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_a_captures_mesh_is_as_large_as_the_field(size, field_file, tmp_path, capsys):
    field = load(field_file)
    capture = fill(tmp_path / "capture", rows=["a.wav,0,0,0"], settings='surface_unit = "cm"\n')
    for part in (2.0, 1.5) if size == 3.0 else ():
        field = change_material(field, "glass", "glass", size=part)
    save(field, tmp_path / "large.safetensors")
    box(capture / "surface.ply", 100.0)
    for to, name in (("gltf", "a.glb"), ("web", "page")):
        extents = shown_in(export(tmp_path / "large.safetensors", to, tmp_path / name, "--capture", capture)).extents
        assert sorted(extents) == pytest.approx(sorted(size * side for side in SIDES), rel=1e-5)
        assert (str(capture / "surface.ply") in capsys.readouterr().err) == (size == 3.0)
    if size == 1.0:
        return
    # What is named by hand is not scaled, which is noted; Gaussians are not at all.
    given = box(tmp_path / "large.stl", 3.0)
    extents = shown_in(export(tmp_path / "large.safetensors", "gltf", tmp_path / "b.glb", "--object", given)).extents
    assert sorted(extents) == pytest.approx(sorted(3.0 * side for side in SIDES), rel=1e-5)
    (note,) = [line for line in capsys.readouterr().err.splitlines() if "3 times" in line]
    assert str(given) in note
    gaussians(capture / "splats.ply")
    (capture / "capture.toml").write_text('surface = "splats.ply"\n')
    with raises(AvmsfError, file=capture / "splats.ply", name="--capture", value=3.0):
        export(tmp_path / "large.safetensors", "web", tmp_path / "other", "--capture", capture)


def test_one_contact_of_an_object_is_exported_with_its_surface(tmp_path: Path) -> None:
    output = export(saved(elastic(), tmp_path), "gltf", tmp_path / "one.glb", "--position", 0.05, 0.02, 0.002)
    np.testing.assert_allclose(sorted(shown_in(output).extents), sorted(SIDES), rtol=0.05)


@pytest.mark.parametrize("given", [("--contacts", 1), ("--position", 0.05, 0.03, 0.002)])
def test_longer_wavs_have_noise_to_their_end(given: tuple[Any, ...], field_file: Path, tmp_path: Path) -> None:
    folder = export(field_file, "wavs", tmp_path / "w", *given, "--seconds", 0.4)
    scale = json.loads((folder / "manifest.json").read_text())["scale"]
    (row,) = table_of(folder / "samples.csv")
    place = [[float(row[axis]) for axis in "xyz"]]
    expected = scale * load(field_file).render(place, forces=1.0, samples=3200)[0]
    np.testing.assert_allclose(soundfile.read(folder / row["file"])[0], expected.numpy(), atol=1e-5)


def test_what_only_render_adds_is_said(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    field = load(field_file)
    heard = replace(field.residual, recordings=torch.zeros(len(field.gain_field.contacts), SAMPLES))
    save(replace(field, residual=heard), tmp_path / "heard.safetensors")
    for words, said in (((), True), (("--no-noise",), False)):
        export(tmp_path / "heard.safetensors", "wavs", tmp_path / f"{said}", "--contacts", 1, *words)
        assert ("in no export" in capsys.readouterr().err) == said
