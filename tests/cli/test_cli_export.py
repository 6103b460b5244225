"""`avmsf export`: every format from a field file, what it says, and what it refuses."""

import csv
import itertools
import json
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.cli import main
from avmsf.editing.material import change_material
from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import AvmsfError, CaptureWarning
from avmsf.export.sampled_field import SampledField
from avmsf.field.config import FitConfig
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.believing_field import ELASTIC, bar, bar_points
from factories.capture_folder import fill
from factories.clouds import random_cloud
from factories.demo_layout import read_arrays
from factories.made_fields import BANK, SIDES, directional, positional, saved
from factories.verbs import run_verb

Streams = pytest.CaptureFixture[str]
RATE, SAMPLES = 8000.0, 1200


@pytest.fixture(scope="module")
def field_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("field") / "plate.safetensors"
    phase = torch.linspace(0, 0.5, len(BANK), dtype=torch.float64)
    noise = Residual(torch.full((9,), 1e-3))
    save(SoundField(BANK, positional(), phase, noise, RATE, SAMPLES, Origin("plate", config=FitConfig(seed=1))), path)
    return path


def test_a_mesh_goes_into_the_glb(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    trimesh.creation.box([1000 * side for side in SIDES]).export(tmp_path / "plate.stl")
    words = ["--object", str(tmp_path / "plate.stl"), "--object-unit", "mm", "--contacts", "20", "--up", "x"]
    assert main(["export", str(field_file), "--to", "gltf", "--output", str(tmp_path / "a.glb"), *words]) == 0
    out, err = capsys.readouterr()
    assert f"wrote {tmp_path / 'a.glb'}: gltf, " in out
    assert "every mode starts as a sine" in err
    assert "% of its loudest sample" in err
    assert " dB on average" in err
    shown = trimesh.load(tmp_path / "a.glb", process=False).dump()[0]
    assert shown.extents == pytest.approx([SIDES[1], SIDES[0], SIDES[2]], rel=1e-5)


def gaussians(path: Path) -> GaussianCloud:
    cloud = random_cloud(positional().points[:40])
    write_splats(cloud, path)
    return cloud


def test_a_mesh_in_another_unit_is_refused(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    trimesh.creation.box([1000 * side for side in SIDES]).export(tmp_path / "plate.stl")
    words = [str(field_file), "--to", "gltf", "--output", str(tmp_path / "a.glb")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        error = refused([*words, "--object", str(tmp_path / "plate.stl")])
    assert (error.file, error.name) == (tmp_path / "plate.stl", "size")
    assert not (tmp_path / "a.glb").exists()


def test_faust_gets_what_it_compiles_unless_asked_for_more(
    field_file: Path, tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [str(field_file), "--to", "faust", "--output", str(tmp_path / "a.dsp")]
    # 64 points of 5 modes with phases and the noise's 1200 samples are 1840 numbers.
    monkeypatch.setattr("avmsf.export.faust.MAX_NUMBERS", 1500)
    assert main(["export", *words]) == 0
    assert re.search(r"\b30\b", capsys.readouterr().err)
    text = (tmp_path / "a.dsp").read_text()
    assert "points = 30;" in text
    assert "noiseDraw" in text
    # Beside the noise 10 would be left: it is given up.
    monkeypatch.setattr("avmsf.export.faust.MAX_NUMBERS", 1300)
    words.append("--overwrite")
    assert main(["export", *words]) == 0
    assert "noise" in capsys.readouterr().err
    text = (tmp_path / "a.dsp").read_text()
    assert "points = 64;" in text
    assert "noiseDraw" not in text
    assert refused([*words, "--contacts", "64"]).value == 1840


def test_without_noise_is_a_flag(field_file: Path, tmp_path: Path) -> None:
    words = ["--to", "faust", "--output", str(tmp_path / "a.dsp"), "--contacts", "3", "--no-noise"]
    assert main(["export", str(field_file), *words]) == 0
    assert "noiseDraw" not in (tmp_path / "a.dsp").read_text()


def test_the_demo_has_the_given_gaussians(field_file: Path, tmp_path: Path) -> None:
    cloud = gaussians(tmp_path / "plate.ply")
    words = ["--to", "avmsf-demo", "--object", str(tmp_path / "plate.ply")]
    assert main(["export", str(field_file), *words, "--output", str(tmp_path / "demo")]) == 0
    assert torch.equal(read_arrays(tmp_path / "demo")["means"], cloud.centers)
    true = SampledField.of(load(field_file), cloud.centers)
    gains = read_arrays(tmp_path / "demo" / "original")["gains"]
    torch.testing.assert_close(gains.abs(), true.gains.abs())
    words += ["--output", str(tmp_path / "few"), "--contacts", "11", "--variant", "glass"]
    assert main(["export", str(field_file), *words]) == 0
    assert json.loads((tmp_path / "few" / "manifest.json").read_text())["variants"] == ["glass"]
    points = read_arrays(tmp_path / "few")["means"]
    rows = [int((cloud.centers - point).norm(dim=1).argmin()) for point in points]
    assert len(set(rows)) == 11
    torch.testing.assert_close(read_arrays(tmp_path / "few" / "glass")["gains"], gains[rows])
    torch.testing.assert_close(read_splats(tmp_path / "few" / "scene.ply").harmonics, cloud.harmonics[rows])


def test_wavs_have_the_layers_asked_for(field_file: Path, tmp_path: Path) -> None:
    words = ["export", str(field_file), "--to", "wavs", "--output", str(tmp_path / "w"), "--contacts", "2"]
    words += ["--pulse", "hertz"]
    assert main([*words, "--forces", "0.5", "2", "--contact-times", "0.001", "0", "--seconds", "0.05"]) == 0
    assert json.loads((tmp_path / "w" / "manifest.json").read_text())["pulses"] == ["hertz", "hertz"]
    with (tmp_path / "w" / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["force"], row["contact_time"]) for row in rows] == [("0.5", "0.001"), ("2", "0")] * 2
    assert soundfile.info(tmp_path / "w" / rows[0]["file"]).frames == 400


def test_wavs_without_noise_are_the_modes(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    words = ["export", str(field_file), "--to", "wavs", "-o", str(tmp_path / "w"), "--contacts", "1", "--no-noise"]
    assert main(words) == 0
    assert "--no-noise" not in capsys.readouterr().err
    sampled = SampledField.of(load(field_file), limit=1)
    modes = sampled.render(torch.tensor([0]), noise=False)[0]
    assert not torch.equal(modes, sampled.render(torch.tensor([0]))[0])
    sound, _ = soundfile.read(tmp_path / "w" / "sounds" / "001-1.wav")
    scale = json.loads((tmp_path / "w" / "manifest.json").read_text())["scale"]
    np.testing.assert_allclose(sound, scale * modes.numpy(), atol=1e-6)


def test_contacts_of_faust_and_of_wavs_have_the_same_numbers(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    words = ["export", str(field_file), "--contacts", "7", "--to"]
    assert main([*words, "faust", "--output", str(tmp_path / "a.dsp"), "--json"]) == 0
    contacts = tmp_path / "a.contacts.csv"
    out, err = capsys.readouterr()
    assert json.loads(out)["contacts"] == str(contacts)
    assert str(contacts) in err
    assert main([*words, "wavs", "--output", str(tmp_path / "w"), "--seconds", "0.01"]) == 0
    tables = []
    for path in (contacts, tmp_path / "w" / "samples.csv"):
        with path.open(newline="") as file:
            tables.append({row["contact"]: [row[axis] for axis in "xyz"] for row in csv.DictReader(file)})
    assert len(tables[0]) == 7
    assert tables[0] == tables[1]


def test_a_sample_set_names_its_instrument(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    output = tmp_path / "samples"
    words = ["export", str(field_file), "--to", "wavs", "--output", str(output), "--contacts", "2", "--seconds", "0.05"]
    assert main([*words, "--json"]) == 0
    out, err = capsys.readouterr()
    instrument = output / "instrument.sfz"
    assert json.loads(out)["instrument"] == str(instrument)
    assert str(instrument) in err
    # One force is one velocity layer; the same command makes several with the options of the last line.
    following = err.splitlines()[-1]
    assert following.startswith("next: ")
    assert main([*words, *re.search(r"--overwrite --forces( [\d.]+)+", following)[0].split()]) == 0
    assert instrument.read_text().count("<region>") == 6
    layers = [soundfile.read(output / "sounds" / f"001-{number}.wav")[0] for number in (1, 2, 3)]
    for one, other in itertools.pairwise(layers):
        assert float(np.corrcoef(one, other)[0, 1]) < 0.999


def test_a_contact_that_is_hardly_heard_is_no_key_unless_it_is_asked_for(
    field_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Streams
) -> None:
    sampled = SampledField.of(load(field_file), limit=5)
    factor = torch.tensor([1.0, 1.0, 1e-3, 1.0, 1.0])[:, None]
    silent = replace(sampled, gains=factor * sampled.gains)
    monkeypatch.setattr("avmsf.cli.export._sampled", lambda *_: silent)
    words = ["export", str(field_file), "--to", "wavs", "--seconds", "0.05"]
    for given, keys in (([], 4), (["--position", "0", "0", "0"], 5)):
        output = tmp_path / str(keys)
        assert main([*words, "--output", str(output), *given]) == 0
        assert len(list((output / "sounds").iterdir())) == keys
    assert "1 contact left out" in capsys.readouterr().err


def test_sfz_is_refused_with_the_format_that_holds_it(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    assert main(["export", str(field_file), "--to", "sfz", "--output", str(tmp_path / "s")]) == 2
    assert "wavs" in capsys.readouterr().err


def test_a_page_is_a_folder_or_one_file(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    words = ["export", str(field_file), "--to", "web", "--contacts", "30"]
    for name in ("page", "page.html"):
        assert main([*words, "--output", str(tmp_path / name)]) == 0
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    assert (manifest["points"], manifest["modes"]) == (30, len(BANK))
    assert (tmp_path / "page" / "index.html").is_file()
    assert b"<html" in (tmp_path / "page.html").read_bytes()
    out, err = capsys.readouterr()
    assert "page: web, " in out
    (*_, served, opened) = [line for line in err.splitlines() if line.startswith("next: ")]
    assert f"http.server --directory {tmp_path / 'page'}" in served
    assert str(tmp_path / "page.html") in opened


def export(words: list[str]) -> None:
    run_verb("export", *words)


def refused(words: list[str]) -> AvmsfError:
    with pytest.raises(AvmsfError) as caught:
        export(words)
    return caught.value


@pytest.mark.parametrize(
    ("to", "name"),
    [
        *(("wavs", "s2.wav"), ("avmsf-demo", "bowl.ZIP"), ("web", "page.glb")),
        *(("gltf", "a.wav"), ("faust", "a"), ("uff", "a.txt")),
    ],
)
def test_a_wrong_ending_is_refused_before_anything_else_is_said(
    to: str, name: str, field_file: Path, tmp_path: Path, capsys: Streams
) -> None:
    place = tmp_path / name
    error = refused([str(field_file), "--to", to, "--output", str(place)])
    assert (error.file, error.name, error.value) == (place, "suffix", place.suffix)
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err == ""


def test_a_folder_may_have_a_dot_in_its_name(field_file: Path, tmp_path: Path) -> None:
    (tmp_path / "old.wav").mkdir()
    for name in ("bowl-1.2", "name.github.io", "old.wav"):
        words = ["--to", "wavs", "--output", str(tmp_path / name), "--contacts", "1", "--seconds", "0.01"]
        assert main(["export", str(field_file), *words]) == 0
        assert (tmp_path / name / "samples.csv").is_file()


def test_what_cannot_be_exported_is_said(field_file: Path, tmp_path: Path) -> None:
    field, out = str(field_file), str(tmp_path / "out")
    error = refused([field, "--to", "wavs", "--output", out, "--contacts", "0"])
    assert (error.name, error.value) == ("--contacts", 0)
    assert refused([str(tmp_path), "--to", "wavs", "--output", out]).file == tmp_path
    words = [field, "--to", "wavs", "--output", out, "--forces", "1", "2", "3", "--contact-times", "0", "0"]
    error = refused(words)
    assert (error.name, error.value) == ("--contact-times", 2)
    words = [field, "--to", "gltf", "--output", str(tmp_path / "a.glb"), "--object", str(tmp_path / "none.obj")]
    assert refused(words).file == tmp_path / "none.obj"
    words = [field, "--to", "uff", "--output", str(tmp_path / "a.uff"), "--functions", "-1"]
    error = refused(words)
    assert (error.name, error.value) == ("functions", -1)
    trimesh.creation.box(SIDES).export(tmp_path / "box.ply")
    words = [field, "--to", "avmsf-demo", "--output", out, "--object", str(tmp_path / "box.ply")]
    assert refused(words).file == tmp_path / "box.ply"
    assert not (tmp_path / "out").exists()
    (tmp_path / "a.dsp").write_text("theirs")
    words = [field, "--to", "faust", "--output", str(tmp_path / "a.dsp"), "--contacts", "3"]
    assert refused(words).file == tmp_path / "a.dsp"
    assert main(["export", *words, "--overwrite"]) == 0


GIVEN = ((0.05, 0.03, 0.002), (0.045, 0.03, 0.002), (0.01, 0.07, 0.002))
"""Contacts, meters."""


@pytest.mark.parametrize("how", ["options", "table"])
def test_a_sample_set_has_the_given_contacts_in_their_order(how: str, field_file: Path, tmp_path: Path) -> None:
    words = [word for place in GIVEN for word in ("--position", *map(str, place))]
    if how == "table":
        lines = ["file,x,y,z", *(f"{row}.wav,{1e3 * x},{1e3 * y},{1e3 * z}" for row, (x, y, z) in enumerate(GIVEN))]
        (tmp_path / "places.csv").write_text("\n".join(lines) + "\n")
        words = ["--contact-table", str(tmp_path / "places.csv"), "--unit", "mm"]
    assert main(["export", str(field_file), "--to", "wavs", "--output", str(tmp_path / "set"), *words]) == 0
    with (tmp_path / "set" / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    places = [[float(row[axis]) for axis in "xyz"] for row in rows]
    np.testing.assert_allclose(places, GIVEN, atol=1e-9)
    scale = json.loads((tmp_path / "set" / "manifest.json").read_text())["scale"]
    expected = scale * load(field_file).render(torch.tensor(GIVEN, dtype=torch.float64))
    for row, sound in zip(rows, expected, strict=True):
        found = soundfile.read(tmp_path / "set" / row["file"], dtype="float32")[0]
        # Both are float32, of a peak below 1.
        np.testing.assert_allclose(found, sound.numpy(), atol=1e-5)


def test_a_sample_set_has_the_directions_of_the_table(tmp_path: Path) -> None:
    path = saved(directional(), tmp_path)
    ways = torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    lines = [
        "x,y,z,nx,ny,nz",
        *(",".join(map(str, (*place, *way))) for place, way in zip(GIVEN, ways.tolist(), strict=True)),
    ]
    (tmp_path / "places.csv").write_text("\n".join(lines) + "\n")
    words = ["--contact-table", str(tmp_path / "places.csv"), "--no-noise"]
    assert main(["export", str(path), "--to", "wavs", "--output", str(tmp_path / "set"), *words]) == 0
    with (tmp_path / "set" / "samples.csv").open() as file:
        rows = list(csv.DictReader(file))
    normals = torch.tensor([[float(row[axis]) for axis in ("nx", "ny", "nz")] for row in rows], dtype=torch.float64)
    torch.testing.assert_close(normals[:2], -torch.nn.functional.normalize(ways[:2]), atol=1e-6, rtol=0.0)
    scale = json.loads((tmp_path / "set" / "manifest.json").read_text())["scale"]
    places = torch.tensor(GIVEN, dtype=torch.float64)
    expected = scale * load(path).render(places, directions=ways, noise=False)
    straight = scale * load(path).render(places, noise=False)
    assert float((expected - straight)[:2].abs().amax()) > 0.01
    for row, sound in zip(rows, expected, strict=True):
        found = soundfile.read(tmp_path / "set" / row["file"], dtype="float32")[0]
        # Both are float32, of a peak below 1.
        np.testing.assert_allclose(found, sound.numpy(), atol=1e-5)


def test_contacts_are_given_in_one_way(field_file: Path, tmp_path: Path) -> None:
    words = [str(field_file), "--to", "wavs", "--output", str(tmp_path / "set"), "--position", "0.05", "0.03", "0.002"]
    error = refused([*words, "--contacts", "3"])
    assert (error.name, error.value) == ("--position", 2)
    far = refused([*words[:-3], "50", "30", "2"])
    assert (far.name, far.value) == ("--position", [50.0, 30.0, 2.0])


def test_a_captures_surface_is_shown(field_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "capture"
    folder.mkdir()
    trimesh.creation.box([100 * side for side in SIDES]).export(folder / "surface.ply")
    (folder / "capture.toml").write_text('surface_unit = "cm"\n')
    words = ["export", str(field_file), "--to", "gltf", "--output", str(tmp_path / "a.glb"), "--capture", str(folder)]
    assert main(words) == 0
    shown = trimesh.load(tmp_path / "a.glb", process=False).dump()[0]
    assert shown.extents == pytest.approx([SIDES[0], SIDES[2], SIDES[1]], rel=1e-5)


@pytest.mark.parametrize("place", ["capture/.avmsf/surface.ply", "plate-surface.ply", ".avmsf/surface.ply"])
@pytest.mark.parametrize("to", ["gltf", "web"])
def test_the_surface_made_from_photographs_is_shown(to: str, place: str, field_file: Path, tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / place).parent.mkdir(exist_ok=True)
    trimesh.creation.box(SIDES).export(tmp_path / place)
    field = (tmp_path / place).parent / "field.safetensors" if place.startswith(".") else tmp_path / "plate.safetensors"
    field.write_bytes(field_file.read_bytes())
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"])
    output = tmp_path / ("a.glb" if to == "gltf" else "page")
    words = ["--to", to, "--output", str(output), "--capture", str(tmp_path / "capture")]
    assert main(["export", str(field), *words]) == 0
    shown = trimesh.load(output if to == "gltf" else output / "object.glb", process=False).dump()[0]
    assert len(shown.faces) == 12


@pytest.mark.parametrize("to", ["gltf", "web"])
def test_the_body_of_the_gains_is_shown_before_a_reconstruction(to: str, tmp_path: Path) -> None:
    # Points on a closed lid above the body, as a reconstruction from outside has it.
    points = torch.cat([bar_points(), bar_points() + torch.tensor([0.0, 0.0, 0.05])]).float()
    bank = ModalBank(ELASTIC, torch.ones(6, dtype=torch.float64))
    noise = Residual(torch.full((9,), 1e-3))
    field = SoundField(
        bank, BodyGains(points, bar()), torch.zeros(6, dtype=torch.float64), noise, RATE, SAMPLES, Origin()
    )
    save(field, tmp_path / "bar.safetensors")
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"])
    (tmp_path / "capture" / ".avmsf").mkdir()
    trimesh.creation.box(SIDES).export(tmp_path / "capture" / ".avmsf" / "surface.ply")
    output = tmp_path / ("a.glb" if to == "gltf" else "page")
    words = ["--to", to, "--output", str(output), "--capture", str(tmp_path / "capture")]
    assert main(["export", str(tmp_path / "bar.safetensors"), *words]) == 0
    shown = trimesh.load(output if to == "gltf" else output / "object.glb", process=False).dump()[0]
    assert len(shown.faces) == len(bar().triangles)
    if to == "web":
        assert json.loads((output / "manifest.json").read_text())["points"] == len(bar_points())


def test_an_edited_field_is_not_paired_with_recordings(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    save(adjust_modes(load(field_file), pitch=2.0), tmp_path / "high.safetensors")
    rows = ["a.wav,0,0,0", "b.wav,0.01,0,0", "c.wav,0.02,0,0"]
    fill(tmp_path / "capture", rows=rows)
    pairs = []
    for field in (field_file, tmp_path / "high.safetensors"):
        page = tmp_path / field.stem
        words = ["--to", "web", "--output", str(page), "--capture", str(tmp_path / "capture")]
        assert main(["export", str(field), *words]) == 0
        manifest = json.loads((page / "manifest.json").read_text())
        noted = any("field is edited" in line for line in capsys.readouterr().err.splitlines())
        pairs.append((len(manifest["strikes"]), noted))
    assert pairs == [(3, False), (0, True)]


def enlarged(field_file: Path, folder: Path) -> Path:
    """Return a file of the field edited twice, to three times its size."""
    field = load(field_file)
    for size in (2.0, 1.5):
        field = change_material(field, "glass", "glass", size=size)
    save(field, folder / "large.safetensors")
    return folder / "large.safetensors"


@pytest.mark.parametrize("to", ["gltf", "web"])
def test_a_captures_mesh_is_as_large_as_the_edited_field(
    to: str, field_file: Path, tmp_path: Path, capsys: Streams
) -> None:
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"], settings='surface_unit = "cm"\n')
    trimesh.creation.box([100 * side for side in SIDES]).export(tmp_path / "capture" / "surface.ply")
    output = tmp_path / ("a.glb" if to == "gltf" else "page")
    words = ["--to", to, "--output", str(output), "--capture", str(tmp_path / "capture")]
    assert main(["export", str(enlarged(field_file, tmp_path)), *words]) == 0
    shown = trimesh.load(output if to == "gltf" else output / "object.glb", process=False).dump()[0]
    assert sorted(shown.extents) == pytest.approx(sorted(3.0 * side for side in SIDES), rel=1e-5)
    assert str(tmp_path / "capture" / "surface.ply") in capsys.readouterr().err


def test_a_captures_gaussians_are_refused_for_a_field_of_another_size(field_file: Path, tmp_path: Path) -> None:
    fill(tmp_path / "capture", rows=["a.wav,0,0,0"], settings='surface = "splats.ply"\n')
    gaussians(tmp_path / "capture" / "splats.ply")
    words = ["--to", "web", "--output", str(tmp_path / "page"), "--capture", str(tmp_path / "capture")]
    error = refused([str(enlarged(field_file, tmp_path)), *words])
    assert (error.file, error.name, error.value) == (tmp_path / "capture" / "splats.ply", "--capture", 3.0)


def test_a_given_object_is_not_scaled_with_a_note(field_file: Path, tmp_path: Path, capsys: Streams) -> None:
    trimesh.creation.box([3.0 * side for side in SIDES]).export(tmp_path / "large.stl")
    words = ["--to", "gltf", "--output", str(tmp_path / "a.glb"), "--object", str(tmp_path / "large.stl")]
    assert main(["export", str(enlarged(field_file, tmp_path)), *words]) == 0
    shown = trimesh.load(tmp_path / "a.glb", process=False).dump()[0]
    assert sorted(shown.extents) == pytest.approx(sorted(3.0 * side for side in SIDES), rel=1e-5)
    (note,) = [line for line in capsys.readouterr().err.splitlines() if "3 times" in line]
    assert str(tmp_path / "large.stl") in note
