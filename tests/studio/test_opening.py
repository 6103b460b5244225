"""What can be opened, what shows the object, and what the page gets of it."""

import io
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avmsf.errors import AvmsfError, StudioError
from avmsf.field.store import save
from avmsf.gaussians.ply import write_splats
from avmsf.pipeline.config import CACHE, CACHED_FIELD, SURFACE
from avmsf.pipeline.scene import CLOUD
from avmsf.studio.files import Showcase
from avmsf.studio.opening import MAX_MESH_BYTES, Opened, find_object, find_reconstructed, open_target
from avmsf.studio.session import Revision
from avmsf.studio.studio import Studio
from factories.capture_folder import fill
from factories.clouds import random_cloud
from factories.raising import raises
from served import plate_field, served

SIDES = (0.24, 0.16, 0.02)


def test_what_can_be_opened_and_what_not(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "note.txt").write_text("hello")
    mesh = tmp_path / "bowl.stl"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    for target, name in (("nothing", "target"), ("empty", "impacts.csv")):
        with raises(StudioError, file=tmp_path / target, name=name):
            open_target(tmp_path / target)
    with raises(StudioError, file=tmp_path / "none.ply", name="object"):
        open_target(mesh, object=tmp_path / "none.ply")
    with raises(AvmsfError, file=tmp_path / "note.txt", value="another, an unreadable or a damaged file"):
        Studio(open_target(tmp_path / "note.txt"), tmp_path)
    opened = open_target(mesh)
    assert opened == Opened("bowl", (tmp_path / "bowl").resolve(), None, (tmp_path / "bowl").resolve())
    assert open_target(mesh) == opened
    assert (tmp_path / "bowl" / "surface.stl").read_bytes() == mesh.read_bytes()
    trimesh.creation.box((0.2, 0.1, 0.1)).export(mesh)
    with raises(StudioError, file=tmp_path / "bowl", name="capture", value="surface.stl"):
        open_target(mesh)
    os.truncate(mesh, MAX_MESH_BYTES + 1)
    with raises(StudioError, file=mesh, value=MAX_MESH_BYTES + 1):
        open_target(mesh)


def test_a_mesh_called_as_a_captures_own_opens_the_folder_that_it_lies_in(tmp_path: Path) -> None:
    mesh = tmp_path / "surface.ply"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    assert open_target(mesh).capture == tmp_path.resolve()
    assert list(tmp_path.iterdir()) == [mesh]
    assert open_target(mesh, capture=tmp_path / "other").capture == (tmp_path / "other").resolve()


def wavefront(folder: Path) -> Path:
    folder.mkdir()
    shape = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 2 3\nf 1 2 4\n"
    (folder / "bowl.obj").write_text(f"mtllib bowl.mtl\n{shape}")
    (folder / "bowl.mtl").write_text("newmtl glazed\nmap_Kd maps/pic.png\n")
    (folder / "maps").mkdir()
    (folder / "maps" / "pic.png").write_bytes(b"the mesh's picture")
    return folder / "bowl.obj"


def test_a_mesh_brings_its_pictures_and_overwrites_none(tmp_path: Path) -> None:
    mesh, other = wavefront(tmp_path / "mesh"), tmp_path / "other"
    other.mkdir()
    (other / "pic.png").write_bytes(b"the user's own picture")
    with raises(StudioError, file=other / "pic.png", name="capture"):
        open_target(mesh, capture=other)
    assert [path.name for path in other.iterdir()] == ["pic.png"]
    assert (other / "pic.png").read_bytes() == b"the user's own picture"
    opened = open_target(mesh, capture=mesh.parent)
    assert find_object(opened) == mesh.parent.resolve() / "surface.obj"
    assert (mesh.parent / "maps" / "pic.png").read_bytes() == b"the mesh's picture"
    beside = open_target(mesh)
    assert beside.capture is not None
    names = sorted(path.name for path in beside.capture.iterdir())
    assert names == ["bowl.mtl", "pic.png", "surface.obj"]


def test_gaussians_are_opened_as_gaussians(tmp_path: Path) -> None:
    points = plate_field().gain_field.points.float()
    write_splats(random_cloud(points), tmp_path / "cloud.ply")
    opened = open_target(tmp_path / "cloud.ply")
    assert opened.capture is not None
    assert find_object(opened) == opened.capture / "splats.ply"
    assert open_target(tmp_path / "cloud.ply") == opened
    assert open_target(opened.capture / "splats.ply") == opened
    (tmp_path / "files").mkdir()
    manifest = Studio(opened, tmp_path / "files").manifest()
    assert manifest["object"] == {"kind": "gaussians", "file": "object.ply"}
    assert manifest["points"] == len(points)


def test_without_field_and_geometry_an_object_is_needed(tmp_path: Path) -> None:
    bare = Revision(1, 1)
    with raises(StudioError, name="object"):
        Showcase(Opened("plate", tmp_path), None).show(bare)
    mesh = tmp_path / "lid.ply"
    trimesh.creation.box(SIDES).export(mesh)
    showcase = Showcase(Opened("plate", tmp_path, object=mesh), None)
    showcase.show(bare)
    assert showcase.current.manifest["points"] > 1000
    assert showcase.current.manifest["object"]["kind"] == "mesh"


def test_a_folder_of_strikes_alone_is_clicked_where_its_contacts_are(tmp_path: Path) -> None:
    folder = fill(tmp_path / "bare")
    with served(open_target(folder), tmp_path / "files") as running:
        manifest = running.manifest()
        assert manifest["points"] > 100
        assert manifest["object"] == {"kind": "points", "file": None}
        # Points between contacts have no sides, which would become the directions of impacts.
        assert "normals" not in manifest["tensors"]
        assert len(running.get("capture").words["strikes"]) == 3


def test_strikes_at_one_place_alone_are_opened(tmp_path: Path) -> None:
    fill(tmp_path / "one", rows=("a.wav,0.1,0,0", "b.wav,0.1,0,0"))
    (tmp_path / "files").mkdir()
    assert Studio(open_target(tmp_path / "one"), tmp_path / "files").manifest()["points"] == 1


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Return a capture folder in which Gaussians, a surface and a field were made."""
    folder = tmp_path / "plate"
    kept = folder / CACHE
    kept.mkdir(parents=True)
    points = plate_field().gain_field.points.float()
    write_splats(random_cloud(points), kept / CLOUD)
    box = trimesh.creation.box(np.ptp(points.numpy(), axis=0) + 0.01)
    box.apply_translation((points.amax(0) + points.amin(0)).numpy() / 2)
    box.export(kept / SURFACE)
    save(plate_field(), kept / CACHED_FIELD)
    # Coordinates of the capture's own files do not count for what was made of them.
    (folder / "capture.toml").write_text('unit = "mm"\n')
    return folder


def test_the_page_gets_the_surface_beside_the_gaussians(capture: Path, tmp_path: Path) -> None:
    with served(open_target(capture), tmp_path / "served") as page:
        # Files of the object are those of the first revision.
        assert page.ask("POST", "edit", {"base": 1, "pitch": 1.1}).status == 200
        manifest = page.manifest()
        assert manifest["live"]["revision"] == 2
        assert manifest["object"] == {"kind": "gaussians", "file": "object.ply"}
        assert manifest["surface"] == {"kind": "mesh", "file": "surface.glb"}
        content = page.get("surface.glb").content
    shown = trimesh.load(io.BytesIO(content), file_type="glb", force="mesh")
    np.testing.assert_allclose(shown.bounds, trimesh.load(capture / CACHE / SURFACE).bounds, atol=1e-6)


def test_a_mesh_of_the_objects_own_needs_no_other(capture: Path, tmp_path: Path) -> None:
    assert find_reconstructed(open_target(capture)) == (capture / CACHE / SURFACE).resolve()
    trimesh.creation.box([1000 * side for side in SIDES]).export(capture / "surface.stl")
    opened = open_target(capture)
    assert find_reconstructed(opened) is None
    with served(opened, tmp_path / "served") as page:
        manifest = page.manifest()
        assert (manifest["object"]["kind"], manifest["surface"]) == ("mesh", None)
        assert page.get("surface.glb").status == 404
