"""`avmsf check` says what shows the object, what is wrong with it, and which command uses it."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from avmsf.capture import CaptureSettings
from avmsf.capture.filenames import pictures_in
from avmsf.capture.settings import METRES
from avmsf.capture.views.read import find_shots
from avmsf.capture.views.shots import without_camera
from avmsf.capture.views.write import write_views
from avmsf.cli import main
from avmsf.cli.visuals import VisualInputs, visual_inputs
from capture_folder import fill
from plate_capture import fill_plate
from small_scene import slab_views, write_surface_file
from views_folder import frames, ring, write_image, write_transforms

Streams = pytest.CaptureFixture[str]


def found(folder: Path) -> VisualInputs:
    visual = visual_inputs(folder, CaptureSettings())
    assert visual is not None
    return visual


def test_photographs_with_cameras_and_masks(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(4)))
    assert found(tmp_path) == VisualInputs(4, "transforms.json", 0, None, None, None, ())
    for name in "abcd":
        write_image(tmp_path / "masks" / f"{name}.png")
    assert found(tmp_path).masks == 4
    assert found(tmp_path).problems == ()


def test_masks_and_camera_files_that_name_no_photograph(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(4)))
    write_image(tmp_path / "masks" / "e.png")
    (tmp_path / "images" / "b.png").unlink()
    visual = found(tmp_path)
    missing, mask = visual.problems
    assert "b.png" in missing
    assert "masks/e.png" in mask
    assert (visual.photographs, visual.masks) == (3, 0)


def test_masks_that_some_photographs_lack_are_a_problem(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(4)))
    for name in "acd":
        write_image(tmp_path / "masks" / f"{name}.png")
    (problem,) = found(tmp_path).problems
    assert "b.png" in problem
    named = [{**frame, "mask_path": f"cut/{name}.png"} for name, frame in zip("abcd", frames(ring(4)), strict=True)]
    write_transforms(tmp_path / "named", named)
    (problem,) = found(tmp_path / "named").problems
    assert problem.startswith("4 photographs")


def test_images_of_a_cache_are_no_photographs(tmp_path: Path) -> None:
    """`avmsf surface FOLDER/images`, of the wrong folder, leaves its cache there."""
    write_transforms(tmp_path, frames(ring(4)))
    write_image(tmp_path / "images" / ".avmsf" / "motion" / "view_000.png")
    assert pictures_in(tmp_path / "images", deep=True) == [tmp_path / "images" / f"{name}.png" for name in "abcd"]
    _, shots = find_shots(tmp_path)
    assert without_camera(shots.shots, tmp_path) == []


def test_an_alpha_channel_is_the_mask_of_its_photograph_alone(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(4)))
    Image.new("RGBA", (8, 8)).save(tmp_path / "images" / "a.png")
    assert found(tmp_path).masks == 1
    (problem,) = found(tmp_path).problems
    assert "b.png" in problem
    assert "a.png" not in problem


@pytest.mark.parametrize("installed", [True, False])
def test_photographs_alone_need_structure_from_motion(
    tmp_path: Path, installed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert visual == VisualInputs(0, None, 0, "turn.mp4", None, "splats.ply", visual.problems)
    # An empty file is opened, and is none of Gaussians.
    (problem,) = visual.problems
    assert "splats.ply" in problem
    assert found(tmp_path).reconstructs
    write_surface_file(tmp_path)
    # Pictures next to a mesh may be its textures.
    assert found(tmp_path).mesh is not None
    assert found(tmp_path).photographs == 0
    assert not found(tmp_path).reconstructs


def test_what_cannot_be_used_is_a_problem(tmp_path: Path) -> None:
    (tmp_path / "one.mp4").touch()
    (tmp_path / "two.mp4").touch()
    assert len(found(tmp_path).problems) == 1
    (tmp_path / "transforms.json").write_text("{}")
    assert "transforms.json" in found(tmp_path).problems[0]


@pytest.mark.parametrize("pictured", [True, False])
def test_the_report_has_them_and_leads_to_the_command_that_uses_them(
    tmp_path: Path, capsys: Streams, pictured: bool
) -> None:
    folder = fill(tmp_path / "cup")
    if pictured:
        write_transforms(folder, frames(ring(4)))
        write_image(folder / "masks" / "e.png")
    assert main(["check", str(folder)]) == 0
    out, err = capsys.readouterr()
    (line,) = [line for line in out.splitlines() if line.startswith("the object is shown by: ")]
    assert ("4 photographs" in line) == pictured
    following = f"avmsf reconstruct {folder} -o field.safetensors" if pictured else f"avmsf modes {folder}"
    assert err.splitlines()[-1] == f"next: {following}"
    assert main(["modes", str(folder)]) == 0
    following = "reconstruct" if pictured else "fit"
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"next: avmsf {following} ")
    # The mask without a photograph counts as a warning.
    assert out.splitlines()[-1] == ("readable, with 1 warning" if pictured else "no problem found")
    assert main(["check", str(folder), "--json"]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert report["visual_inputs"]["photographs"] == 4 * pictured
    assert len(report["visual_inputs"]["problems"]) == pictured


@pytest.mark.parametrize("unit", ["m", "mm", "in"])
def test_the_unit_of_contacts_is_found_from_photographs(tmp_path: Path, capsys: Streams, unit: str) -> None:
    folder = fill_plate(tmp_path / "slab", surface=False)
    write_views(slab_views(64), tmp_path / "views")
    for each in (tmp_path / "views").iterdir():
        each.rename(folder / each.name)
    header, *rows = (folder / "impacts.csv").read_text().split()
    cells = [row.split(",") for row in rows]
    for row in cells:
        row[1:4] = [str(float(cell) / METRES[unit]) for cell in row[1:4]]
    (folder / "impacts.csv").write_text("\n".join([header, *map(",".join, cells)]))
    (folder / "capture.toml").unlink()
    proposed = [] if unit == "m" else [unit]
    for words, found in (((), proposed), (("--write-settings",), proposed), ((), [])):
        assert main(["check", str(folder), "--json", *words]) in (0, 2)
        proposals = json.loads(capsys.readouterr().out)["proposals"]
        assert [each["value"] for each in proposals if each["key"] == "unit"] == found
    if proposed:
        assert CaptureSettings.read(folder / "capture.toml").unit == unit


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
def test_a_file_that_looks_like_an_input_and_is_not_used_is_named_and_ends_a_fit(
    tmp_path: Path, name: str, advice: str, capsys: Streams
) -> None:
    folder = fill_plate(tmp_path / "plate")
    (folder / "surface.obj").unlink(missing_ok=True)
    (folder / "surface.ply").unlink(missing_ok=True)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).touch()
    (sentence,) = found(folder).unused
    assert sentence.startswith(name.removesuffix("0001.jpg"))
    assert advice in sentence
    for verb in ("fit", "reconstruct"):
        assert main([verb, str(folder), "-o", str(tmp_path / "field.safetensors"), "--json"]) == 2
        assert json.loads(capsys.readouterr().out)["error"]["value"] == [sentence]
    assert not (tmp_path / "field.safetensors").exists()


def test_every_file_of_a_capture_with_photographs_or_a_mesh_is_used(tmp_path: Path) -> None:
    write_transforms(fill_plate(tmp_path), frames(ring(4)))
    assert found(tmp_path).unused == ()


def test_a_field_of_positions_has_to_be_asked_for_where_photographs_show_the_object(
    tmp_path: Path, capsys: Streams
) -> None:
    folder = fill_plate(tmp_path / "plate")
    for path in folder.glob("surface.*"):
        path.unlink()
    write_transforms(folder, frames(ring(4)))
    words = ["fit", str(folder), "-o", str(tmp_path / "f.safetensors"), "--gain-model", "smooth", "--steps", "1"]
    assert main([*words, "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["error"]["name"] == "shape"
    assert main([*words, "--without-shape"]) == 0
