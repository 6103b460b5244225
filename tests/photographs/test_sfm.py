"""Cameras found from pictures alone, against those that took them; and whatever can go wrong on the way."""

import json
import math
import subprocess
import sys
import textwrap
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs import read_views
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.mesh_views import render_views
from avmsf.photographs.sfm import WORKER, estimate_cameras
from factories.raising import raises
from factories.running import gone

VIEWS, SIZE = 7, 256


def scene() -> TexturedMesh:
    """A hilly ground, 0.4 m wide, with a texture that has details of every size."""
    rng = np.random.default_rng(3)
    texture = np.zeros((512, 512, 3), dtype=np.float32)
    for cells in (4, 8, 16, 32, 64, 128):
        texture += cv2.resize(rng.normal(size=(cells, cells, 3)).astype(np.float32), (512, 512))
    side = 21
    heights = cv2.resize(rng.normal(size=(6, 6)), (side, side), interpolation=cv2.INTER_CUBIC)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)), axis=-1)
    vertices = np.concatenate([0.4 * (grid - 0.5), 0.02 * heights[..., None]], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    squares = np.stack([corner, corner + 1, corner + side + 1, corner, corner + side + 1, corner + side], axis=1)
    faces = squares.reshape(-1, 3)
    image = torch.from_numpy(np.clip(128 + 40 * texture, 0, 255).astype(np.uint8))
    points, corners, places = map(torch.from_numpy, (vertices, faces, grid.reshape(-1, 2)[faces]))
    return TexturedMesh.build(points, corners, coordinates=places, textures=[image])


@pytest.fixture(scope="module")
def taken() -> tuple[View, ...]:
    cameras = []
    for number in range(VIEWS):
        azimuth, elevation = math.radians(12 * number), math.radians(50 + 12 * (number % 2))
        flat = math.cos(elevation)
        place = 0.5 * torch.tensor([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
        up = torch.tensor([0.0, 0.0, 1.0])
        cameras.append(Camera.looking(place, torch.zeros(3), up=up, focal=1.1 * SIZE, width=SIZE, height=SIZE))
    return render_views(scene(), cameras, supersample=2)


@pytest.fixture(scope="module")
def found(taken: tuple[View, ...], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Pictures of the scene, one of them WebP, with one that shows nothing and one that is cut short; and warnings."""
    folder = tmp_path_factory.mktemp("scene")
    fill(folder / "images", taken)
    (folder / "images/view_004.png").unlink()
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    cv2.imwrite(str(folder / "images/view_004.webp"), taken[4].image.numpy()[..., ::-1], lossless)
    cv2.imwrite(str(folder / "images/wall.png"), np.full((SIZE, SIZE, 3), 90, dtype=np.uint8))
    (folder / "images/zero.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.warns(CaptureWarning) as caught:
        model = estimate_cameras(folder / "images", folder, features=512, threads=1, timeout=120.0)
    assert model == folder / "sparse/0"
    return folder, {each.message.name: each.message.value for each in caught}


def fill(folder: Path, views: tuple[View, ...]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for view in views:
        cv2.imwrite(str(folder / f"{view.name}.png"), view.image.numpy()[..., ::-1])
    return folder


def test_cameras_agree_with_the_true_ones_up_to_a_similarity(taken: tuple[View, ...], found: tuple[Path, dict]) -> None:
    folder, _ = found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)  # of the two images without cameras
        views = read_views(folder)
    assert len(views) == VIEWS
    assert "view_004.webp" in [view.name for view in views]
    places, true_places = (torch.stack([view.camera.position for view in each]).numpy() for each in (views, taken))
    # As docs/visual-inputs.md says.
    matrix = trimesh.registration.procrustes(places, true_places, reflection=False)[0]
    back, scale = torch.from_numpy(np.linalg.inv(matrix)), np.cbrt(np.linalg.det(matrix[:3, :3]))
    for view, true in zip(views, taken, strict=True):
        pose = view.camera.world_to_camera @ back
        pose[:3] *= scale
        camera = replace(view.camera, world_to_camera=pose)
        # Features are found to a tenth of a pixel, here a 3000th of the distance.
        assert float((camera.position - true.camera.position).norm()) < 0.01 * 0.5
        turn = camera.world_to_camera[:3, :3] @ true.camera.world_to_camera[:3, :3].T
        assert math.degrees(math.acos(min(1.0, (float(turn.trace()) - 1) / 2))) < 0.5


def test_only_the_model_is_left_and_images_without_a_camera_are_named(found: tuple[Path, dict]) -> None:
    folder, remarks = found
    assert remarks == {"unreadable images": ["zero.jpg"], "cameras": ["wall.png"]}
    assert sorted(path.name for path in folder.iterdir()) == ["images", "sparse"]
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {path.name for path in (folder / "sparse/0").iterdir()}
    with raises(CaptureError, file="sparse/0"):
        estimate_cameras(folder / "images", folder)


@pytest.mark.slow
def test_masks_count(taken: tuple[View, ...], tmp_path: Path) -> None:
    contents = []
    for name in ("whole", "masked"):
        fill(tmp_path / name / "images", taken[:4])
        if name == "masked":
            mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
            mask[:, : SIZE // 2] = 255
            (tmp_path / name / "masks").mkdir()
            for view in taken[:4]:
                cv2.imwrite(str(tmp_path / name / "masks" / f"{view.name}.png"), mask)
        estimate_cameras(tmp_path / name / "images", tmp_path / name, features=512, threads=1, seed=5)
        contents.append((tmp_path / name / "sparse/0/images.bin").read_bytes())
    # Each feature is 24 bytes, x and y in float64 first, behind the image's 64 bytes, name and count.
    for content, most in zip(contents, (SIZE, SIZE // 2), strict=True):
        start = content.index(b".png\0") + len(b".png\0")
        count = int.from_bytes(content[start : start + 8], "little")
        rows = np.frombuffer(content[start + 8 : start + 8 + 24 * count], dtype=np.dtype("<f8, <f8, <u8"))
        assert count > 50
        assert most - 30 < rows["f0"].max() < most + 1


def pretend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let another script do the worker's part."""
    path = tmp_path / "pretended.py"
    path.write_text("import json, os, pathlib, sys, time\n" + textwrap.dedent(script))
    monkeypatch.setattr("avmsf.photographs.sfm.WORKER", path)


def write_models(*groups: tuple[str, ...]) -> str:
    return f"""
        folder, groups = pathlib.Path(sys.argv[1]).parent, dict(enumerate({groups!r}))
        for number, names in groups.items():
            (folder / "models" / str(number)).mkdir(parents=True)
            (folder / "models" / str(number) / "names").write_text(" ".join(names))
        (folder / "result.json").write_text(json.dumps(groups))
    """


def pictures(folder: Path, names: str) -> Path:
    (folder / "images").mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / "images" / f"{name}.png"), np.zeros((8, 8, 3), dtype=np.uint8))
    return folder


def test_of_several_models_the_largest_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = pictures(tmp_path / "cup", "abcdefgh")
    pretend(tmp_path, monkeypatch, write_models(("a.png", "b.png", "c.png"), ("c.png", "d.png", "e.png", "f.png")))
    with pytest.warns(CaptureWarning) as caught:
        estimate_cameras(folder / "images", folder)
    remarks = {warning.message.name: warning.message.value for warning in caught}
    assert remarks == {"groups": [["a.png", "b.png"]], "cameras": ["g.png", "h.png"]}
    assert (folder / "sparse/0/names").read_text() == "c.png d.png e.png f.png"


@pytest.mark.parametrize("groups", [(), (("a.png", "b.png", "c.png"),), (("a.png", "b.png"), ("c.png", "d.png"))])
def test_too_few_cameras_are_refused_by_name(tmp_path, monkeypatch, groups):
    folder = pictures(tmp_path / "cup", "abcdefgh")
    pretend(tmp_path, monkeypatch, write_models(*groups))
    registered = groups[0] if groups else ()
    lacking = [f"{name}.png" for name in "abcdefgh" if f"{name}.png" not in registered]
    with raises(CaptureError, file="images", name="cameras", value=lacking):
        estimate_cameras(folder / "images", folder)
    assert [path.name for path in folder.iterdir()] == ["images"]


def test_a_crash_shows_the_workers_last_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = pictures(tmp_path / "cup", "abc")
    pretend(tmp_path, monkeypatch, 'print("stage matches")\nprint("no memory left", flush=True)\nos.abort()')
    with raises(CaptureError, name="matches", value="SIGABRT") as caught:
        estimate_cameras(folder / "images", folder)
    assert "no memory left" in str(caught.value)
    pretend(tmp_path, monkeypatch, "raise RuntimeError('odd images')")
    with raises(CaptureError, name="starting", value="exit status 1") as caught:
        estimate_cameras(folder / "images", folder)
    assert "RuntimeError: odd images" in str(caught.value)
    assert [path.name for path in folder.iterdir()] == ["images"]


SLEEP = """
    print("stage features", flush=True)
    pathlib.Path(__file__).with_name("pid").write_text(f"{os.getpid()}")
    time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="sees processes through /proc")
def test_time_ends_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = pictures(tmp_path / "cup", "abc")
    pretend(tmp_path, monkeypatch, SLEEP)
    with raises(CaptureError, name="features", value=3.0):
        estimate_cameras(folder / "images", folder, timeout=3.0)
    assert gone([int((tmp_path / "pid").read_text())])
    assert [path.name for path in folder.iterdir()] == ["images"]


def test_the_worker_ends_when_its_parent_does(taken: tuple[View, ...], tmp_path: Path) -> None:
    fill(tmp_path / "images", taken)
    names = sorted(path.name for path in (tmp_path / "images").iterdir())
    job = {"names": dict(zip(names, names, strict=True)), "seed": 0, "features": 8192, "threads": 1}
    (tmp_path / "job.json").write_text(json.dumps(job))
    command = [sys.executable, "-P", str(WORKER), str(tmp_path / "job.json")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as worker:
        assert worker.stdout.readline() == b"stage features\n"
        # What a dying parent leaves behind: its end of the pipe, closed.
        worker.stdin.close()
        assert worker.wait(10) == 1
    assert not (tmp_path / "result.json").exists()


def test_what_cannot_begin_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = pictures(tmp_path / "cup", "abc")
    pictures(tmp_path / "few", "ab")
    pictures(tmp_path / "sizes", "abc")
    cv2.imwrite(str(tmp_path / "sizes/images/d.png"), np.zeros((8, 12, 3), dtype=np.uint8))
    (tmp_path / "file").write_text("")
    for images, model, settings, attributes in (
        ("few/images", "few", {}, {"file": "images", "name": "photographs", "value": 2}),
        ("few/pictures", "few", {}, {"file": "pictures"}),
        ("sizes/images", "sizes", {}, {"file": "images", "name": "sizes", "value": ["d.png"]}),
        ("cup/images", "cup", {"timeout": 0.0}, {"name": "timeout", "value": 0.0}),
        ("cup/images", "file/sfm", {}, {"file": "sfm"}),
    ):
        with raises(CaptureError, **attributes):
            estimate_cameras(tmp_path / images, tmp_path / model, **settings)

    def full(*_: object, **__: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", full)
    with raises(CaptureError, name="starting"):
        estimate_cameras(folder / "images", folder)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with raises(CaptureError, name="pycolmap"):
        estimate_cameras(folder / "images", folder)
    assert sorted(path.name for path in folder.iterdir()) == ["images"]
