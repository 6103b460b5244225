"""What check says of recordings, alignment and whatever shows the object."""

import importlib.util
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from avmsf.capture import CaptureSettings
from avmsf.capture.filenames import expect_views, pictures_in
from avmsf.cli import main
from avmsf.errors import SceneError
from avmsf.gaussians.ply import write_splats
from avmsf.mesh.surface import Surface, surface_points
from avmsf.photographs.folder import read_camera_file, write_frames
from avmsf.pipeline.visual_checks import VisualInputs, inputs, misplaced
from factories.capture_folder import fill
from factories.clouds import random_cloud
from factories.delayed_plate import delays, strikes
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.small_scene import slab, slab_views
from factories.verbs import Streams, results_of
from factories.views_folder import frames, write_image, write_transforms
from factories.views_folder import ring as camera_ring


def test_no_settings_are_written_into_a_dataset(tmp_path: Path) -> None:
    fill(tmp_path / "cup")
    assert main(["check", str(tmp_path)]) == 0
    assert main(["check", str(tmp_path), "--write-settings"]) == 2


def fill_delayed(folder: Path, *, own_phases: int | None = None) -> Path:
    """Write recordings of impacts that are parts of samples off; one may have phases of its own."""
    made = strikes(8, starts=delays(8))
    files = torch.cat([made.before, made.sounds, made.after], dim=1).numpy()
    sounds = {f"{row}.wav": np.gradient(file) if row == own_phases else file for row, file in enumerate(files)}
    return fill(folder, sounds=sounds)


def test_check_and_modes_report_one_alignment(tmp_path: Path, capsys: Streams) -> None:
    found, other = (results_of(capsys, verb, fill_delayed(tmp_path))[0]["alignment"] for verb in ("check", "modes"))
    assert found == other
    assert found["coherence_after"] > 0.99 > found["coherence_before"]
    assert found["not_aligned"] == []


def test_what_is_wrong_with_the_alignment_is_a_problem(tmp_path: Path, capsys: Streams) -> None:
    report, err = results_of(capsys, "check", fill_delayed(tmp_path, own_phases=3))
    assert report["alignment"]["not_aligned"] == ["3.wav"]
    assert "no problem found" not in err


COMMANDS = ("check", "fit -o OUT.safetensors")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_names_the_unit_of_the_mesh_and_writes_nothing(command, tmp_path, capsys):
    # Contacts in meters, and a mesh in a unit that the settings do not name.
    folder = fill_plate(tmp_path / "plate", surface=False)
    Surface(1000 * slab().vertices, slab().faces).write(folder / "surface.ply")
    before = sorted(folder.rglob("*"))
    verb, *words = command.replace("OUT", str(tmp_path / "out")).split()
    assert main([verb, str(folder), *words]) == 2
    said = capsys.readouterr()
    assert 'surface_unit = "mm"' in said.out + said.err
    assert sorted(folder.rglob("*")) == before
    assert [each.name for each in tmp_path.iterdir()] == ["plate"]


def found(folder: Path) -> VisualInputs:
    visual = inputs(folder, CaptureSettings())
    assert visual is not None
    return visual


def images(folder: Path, *names: str) -> None:
    for name in names:
        write_image(folder / name)


NAMED = [{**frame, "mask_path": f"cut/{name}.png"} for name, frame in zip("abcd", frames(camera_ring(4)), strict=True)]
MASKS: dict[str, tuple[Callable[[Path], object], int, int, list[str]]] = {
    "none": (lambda folder: None, 4, 0, []),
    "all": (lambda folder: images(folder, *(f"masks/{name}.png" for name in "abcd")), 4, 4, []),
    "of no photograph": (lambda folder: images(folder, "masks/e.png"), 4, 0, ["masks/e.png"]),
    "all but one": (lambda folder: images(folder, *(f"masks/{name}.png" for name in "acd")), 4, 3, ["b.png"]),
    "named, not there": (lambda folder: write_transforms(folder, NAMED), 4, 0, ["4 photographs"]),
    "an alpha channel": (lambda folder: Image.new("RGBA", (8, 8)).save(folder / "images" / "a.png"), 4, 1, ["b.png"]),
    "no photograph": (lambda folder: (folder / "images" / "b.png").unlink(), 3, 0, ["b.png"]),
}


@pytest.mark.parametrize("case", MASKS)
def test_photographs_with_cameras_and_masks(case: str, tmp_path: Path) -> None:
    """What a change of the folder gives: photographs, those with a mask, and what the problems name."""
    write_transforms(tmp_path, frames(camera_ring(4)))
    change, photographs, masks, problems = MASKS[case]
    change(tmp_path)
    visual = found(tmp_path)
    assert (visual.photographs, visual.cameras, visual.masks) == (photographs, "transforms.json", masks)
    assert len(visual.problems) == len(problems)
    assert all(name in problem for name, problem in zip(problems, visual.problems, strict=True))


def test_an_empty_folder_of_images_is_refused_unless_a_mesh_shows_the_object(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with raises(SceneError, file=tmp_path):
        expect_views(tmp_path, CaptureSettings())
    (tmp_path / "surface.obj").touch()
    expect_views(tmp_path, CaptureSettings())


def test_images_of_a_cache_are_no_photographs(tmp_path: Path) -> None:
    """`avmsf fit FOLDER/images`, of the wrong folder, leaves its cache there."""
    write_transforms(tmp_path, frames(camera_ring(4)))
    write_image(tmp_path / "images" / ".avmsf" / "motion" / "view_000.png")
    assert pictures_in(tmp_path / "images", deep=True) == [tmp_path / "images" / f"{name}.png" for name in "abcd"]
    assert read_camera_file(tmp_path).without_camera() == []


@pytest.mark.parametrize("installed", [True, False])
def test_photographs_alone_need_structure_from_motion(tmp_path, installed, monkeypatch):
    for name in "abc":
        write_image(tmp_path / "images" / f"{name}.jpg")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if installed else None)
    visual = found(tmp_path)
    assert (visual.photographs, visual.cameras, visual.masks) == (3, None, 0)
    assert len(visual.problems) == (not installed)


def test_a_mesh_video_and_gaussians_are_named(tmp_path: Path) -> None:
    (tmp_path / "splats.ply").touch()
    (tmp_path / "turn.mp4").touch()
    visual = found(tmp_path)
    assert visual == VisualInputs(0, None, 0, "turn.mp4", None, "splats.ply", ())
    assert visual.reconstructs
    (tmp_path / "two.mp4").touch()
    assert len(found(tmp_path).problems) == 1
    (tmp_path / "transforms.json").write_text("{}")
    assert "transforms.json" in found(tmp_path).problems[0]
    slab().write(tmp_path / "surface.ply")
    # Pictures next to a mesh may be its textures.
    assert found(tmp_path).mesh is not None
    assert not found(tmp_path).reconstructs


def pictured_slab(folder: Path) -> Path:
    """A struck plate that is the upper side of a slab in photographs with cameras and masks."""
    fill_plate(folder, surface=False)
    write_frames(slab_views(64), folder)
    return folder


Y_UP = np.array([[1.0, 0, 0, 0.3], [0, 0, 1, 0.1], [0, -1, 0, -0.2], [0, 0, 0, 1]])
CAMERAS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "as they are": (lambda pose: pose, ""),
    "moved": (lambda pose: Y_UP @ pose, "contacts on the object in the photographs, got most outside"),
    "OpenCV's axes": (lambda pose: pose @ np.diag([1.0, -1, -1, 1]), "check the poses of the cameras"),
}


def said_of(folder: Path) -> list[str]:
    """Return what is wrong with all that shows the object, alone and next to the contacts."""
    visual = found(folder)
    return [*visual.problems, *map(str, misplaced(folder, visual))]


@pytest.mark.parametrize("case", CAMERAS)
def test_what_is_wrong_with_cameras_is_named(tmp_path: Path, case: str) -> None:
    folder, (change, words) = pictured_slab(tmp_path / "slab"), CAMERAS[case]
    record = json.loads((folder / "transforms.json").read_text())
    for frame in record["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    (folder / "transforms.json").write_text(json.dumps(record))
    said = said_of(folder)
    assert any(words in each for each in said) if words else said == []


def in_centimeters(folder: Path) -> Path:
    """Write the contacts of a folder in centimeters, as no setting says."""
    head, *rows = (folder / "impacts.csv").read_text().split()
    cells = [(name, *(str(100 * float(each)) for each in place[:3]), *place[3:]) for name, *place in
             (row.split(",") for row in rows)]  # fmt: skip
    (folder / "impacts.csv").write_text("\n".join([head, *map(",".join, cells), ""]))
    return folder


def test_check_leads_to_the_unit_without_which_fit_refuses(tmp_path: Path, capsys: Streams) -> None:
    folder = in_centimeters(pictured_slab(tmp_path / "slab"))
    settings = (folder / "capture.toml").read_text()
    # By hand, where there are settings, which the command leaves alone.
    assert main(["check", str(folder)]) == 0
    said = capsys.readouterr()
    assert 'unit = "mm"' not in said.out
    assert f'next: add unit = "cm" to {folder / "capture.toml"}' in said.err
    assert main(["check", str(folder), "--write-settings"]) == 2
    assert (folder / "capture.toml").read_text() == settings
    (folder / "capture.toml").unlink()
    capsys.readouterr()
    assert main(["check", str(folder)]) == 0
    assert not (folder / "capture.toml").exists()
    assert capsys.readouterr().err.splitlines()[-1] == f"next: avmsf check {folder} --write-settings"
    assert main(["check", str(folder), "--write-settings"]) == 0
    said = capsys.readouterr()
    assert CaptureSettings.read(folder / "capture.toml") == CaptureSettings(unit="cm")
    assert "outlines" not in said.out
    assert said.err.splitlines()[-1].startswith("next: avmsf fit")
    # With them nothing more is proposed, so that nothing is written.
    written = (folder / "capture.toml").read_bytes()
    assert main(["check", str(folder), "--write-settings"]) == 0
    assert (folder / "capture.toml").read_bytes() == written
    capsys.readouterr()
    # A unit that was chosen is not proposed, and fit refuses it.
    (folder / "capture.toml").write_text(f'{settings}\nunit = "m"\n')
    assert main(["check", str(folder)]) == 0
    said = capsys.readouterr()
    assert "proposed: unit" not in said.out
    assert said.err.splitlines()[-1].startswith("next: correct")


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("as they are", ""),
        ("nan", "expected a finite float32 number as y of each vertex, got nan"),
        ("y down", "(x, y, z) taken as (x, -y, -z)"),
    ],
)
def test_gaussians_are_opened_and_another_frame_is_told(tmp_path: Path, case: str, words: str) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    centers = surface_points(slab(), count=2000)
    if case == "y down":
        centers = centers * torch.tensor([1.0, -1.0, -1.0])
    cloud = random_cloud(centers)
    if case == "nan":
        cloud.centers[7, 1] = math.nan
    write_splats(cloud, folder / "splats.ply")
    said = said_of(folder)
    assert [words in each and "feet" not in each for each in said] == [True] * bool(words)


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("bowl_scan.obj", 'surface = "bowl_scan.obj"'),
        ("scan/textured.glb", 'surface = "scan/textured.glb"'),
        ("surface.usdz", "surface.obj"),
        ("splats.spz", "splats.ply"),
        ("point_cloud/iteration_30000/point_cloud.ply", "splats.ply"),
        ("train/transforms_train.json", "transforms.json"),
        ("keyframes/0001.jpg", "images"),
        ("IMG_0001.HEIC", ".jpg"),
        ("table.xlsx", "impacts.csv"),
    ],
)
def test_a_file_that_looks_like_an_input_and_is_not_used_is_named_and_ends_a_fit(tmp_path, name, advice, capsys):
    folder = fill_plate(tmp_path / "plate")
    (folder / "surface.obj").unlink(missing_ok=True)
    (folder / "surface.ply").unlink(missing_ok=True)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()
    (sentence,) = found(folder).unused
    assert sentence.startswith(name.removesuffix("0001.jpg"))
    assert advice in sentence
    assert main(["fit", str(folder), "-o", str(tmp_path / "field.safetensors"), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["value"] == [sentence]
    assert not (tmp_path / "field.safetensors").exists()


def test_every_file_of_a_capture_with_photographs_or_a_mesh_is_used(tmp_path: Path) -> None:
    write_transforms(fill_plate(tmp_path), frames(camera_ring(4)))
    assert found(tmp_path).unused == ()
