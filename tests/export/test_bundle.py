"""What a page reads is the field, and the object beside it; read back by hand."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.capture.impacts import Impacts
from avmsf.errors import AvmsfError, ExportError
from avmsf.export.bundle import make_bundle
from avmsf.export.geometry import read_object
from avmsf.export.sampled_field import SampledField
from avmsf.export.web import write_webpage
from avmsf.gaussians.ply import write_splats
from avmsf.mesh.surface import Surface
from factories.clouds import random_cloud
from factories.raising import raises
from factories.struck_table import RATE, struck_table


def tensors(folder: Path) -> dict[str, np.ndarray]:
    """Read the tensors as a stranger would."""
    manifest = json.loads((folder / "manifest.json").read_text())
    found = {}
    for name, record in manifest["tensors"].items():
        count = int(np.prod(record["shape"]))
        kind = np.dtype(record["dtype"]).newbyteorder("<")
        values = np.frombuffer((folder / record["file"]).read_bytes(), kind, count, record["offset"])
        found[name] = values.reshape(record["shape"])
    return found


@pytest.mark.parametrize("shared", [True, False])
def test_tensors_are_the_tables_to_the_last_bit(tmp_path: Path, shared: bool) -> None:
    table = struck_table(shared=shared, points=5, modes=3, seconds=0.0300625)
    written = make_bundle(table).write(tmp_path / "page")
    found = tensors(tmp_path / "page")
    parts = {"sine": table.gains.real, "cosine": table.gains.imag}
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    for name in ("points", "normals", "frequency", "damping", "sine", "cosine", "noise"):
        expected = (parts[name] if name in parts else getattr(table, name)).numpy()
        assert found[name].dtype == expected.dtype
        assert np.array_equal(found[name], expected), name
        # JavaScript reads numbers at multiples of their size alone.
        assert manifest["tensors"][name]["offset"] % expected.itemsize == 0
    assert "cosine" not in make_bundle(replace(table, gains=table.gains.real + 0j)).manifest["tensors"]
    assert manifest["damping"] == ("shared" if shared else "perContact")
    assert (manifest["modes"], manifest["points"], manifest["samples"]) == (3, 5, 481)
    assert (manifest["sampleRate"], manifest["perNewton"], manifest["name"]) == (RATE, True, "ball")
    assert manifest["object"] == {"kind": "points", "file": None}
    assert (manifest["strikes"], manifest["live"]) == ([], None)
    assert written.size == sum(path.stat().st_size for path in (tmp_path / "page").rglob("*") if path.is_file())


def test_strikes_are_heard_as_they_were_recorded(tmp_path: Path) -> None:
    sounds = 3.0 * torch.randn(2, 500, generator=torch.Generator().manual_seed(0))
    contacts = torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64)
    strikes = Impacts(contacts, sounds, RATE, ("a.wav", "../b.wav"), directions=-contacts.float() * 10)
    make_bundle(struck_table(shared=True), strikes=strikes).write(tmp_path / "page")
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    assert [each["name"] for each in manifest["strikes"]] == ["a.wav", "../b.wav"]
    assert [each["sound"] for each in manifest["strikes"]] == ["strikes/001.wav", "strikes/002.wav"]
    assert manifest["strikes"][1]["contact"] == [0.0, 0.1, 0.0]
    assert manifest["strikes"][1]["direction"] == [0.0, -1.0, 0.0]
    for row, each in enumerate(manifest["strikes"]):
        sound, rate = soundfile.read(tmp_path / "page" / each["sound"], dtype="float32")
        assert rate == RATE
        assert np.array_equal(sound, sounds[row].numpy())


def ball_surface(radius: float = 0.1, divisions: int = 2) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=divisions, radius=radius)
    return Surface(torch.from_numpy(mesh.vertices).float(), torch.from_numpy(mesh.faces).long())


def ball_points(count: int = 300) -> torch.Tensor:
    return struck_table(shared=True, points=count, modes=1).points


def ball_table() -> SampledField:
    return struck_table(shared=True, points=300, modes=2, seconds=0.1)


def shown_mesh(content: bytes) -> trimesh.Trimesh:
    return trimesh.load_mesh(trimesh.util.wrap_as_stream(content), file_type="glb", process=False)


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb"])
def test_a_mesh_in_millimeters_is_shown_in_meters_with_its_colors(tmp_path: Path, ending: str) -> None:
    path, mesh = tmp_path / f"ball.{ending}", trimesh.creation.icosphere(subdivisions=1, radius=100.0)
    mesh.visual.vertex_colors = np.r_["1", np.arange(42)[:, None] * [1, 2, 3], np.full((42, 1), 255)].astype(np.uint8)
    mesh.export(path)
    loaded = shown_mesh(read_object(path, ball_points(), meters=1e-3)[1])
    np.testing.assert_allclose(np.linalg.norm(loaded.vertices, axis=1), 0.1, rtol=1e-5)
    if ending == "ply":
        assert np.array_equal(loaded.visual.vertex_colors, mesh.visual.vertex_colors)
    surface = ball_surface()
    loaded = shown_mesh(read_object(surface, ball_points())[1])
    np.testing.assert_allclose(loaded.vertices, surface.vertices.numpy(), rtol=0, atol=1e-7)
    assert np.array_equal(loaded.faces, surface.faces.numpy())
    with raises(ExportError, file=path, name="size", value=pytest.approx(1000.0, rel=0.1)):
        read_object(path, ball_points())


def test_a_mesh_of_too_many_triangles_is_reduced_with_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avmsf.export.geometry.MAX_FACES", 1000)
    surface = ball_surface(divisions=4)
    _, content, (remark,) = read_object(surface, ball_points())
    mesh = shown_mesh(content)
    assert 500 < len(mesh.faces) <= 1000
    assert float(np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.1).max()) < 0.005
    assert "5,120" in remark
    assert f"{len(mesh.faces):,}" in remark


def test_gaussians_are_kept_as_they_are(tmp_path: Path) -> None:
    points = ball_points()
    write_splats(random_cloud(points), tmp_path / "ball.ply")
    make_bundle(ball_table(), object=tmp_path / "ball.ply").write(tmp_path / "page")
    assert (tmp_path / "page" / "object.ply").read_bytes() == (tmp_path / "ball.ply").read_bytes()
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    assert manifest["object"] == {"kind": "gaussians", "file": "object.ply"}
    (tmp_path / "short.ply").write_bytes((tmp_path / "ball.ply").read_bytes()[:-100])
    with pytest.raises(AvmsfError) as caught:
        read_object(tmp_path / "short.ply", points)
    assert "short.ply" in str(caught.value)


def test_a_surface_is_carried_beside_the_object_by_a_page_in_one_file(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=2, radius=0.1).export(tmp_path / "ball.ply")
    trimesh.PointCloud(ball_points().numpy()).export(tmp_path / "bare.ply")
    bare = make_bundle(ball_table(), surface=tmp_path / "bare.ply")
    assert (bare.manifest["surface"], "has no triangles" in bare.remarks[0]) == (None, True)
    write_webpage(ball_table(), tmp_path / "page.html", surface=tmp_path / "ball.ply")
    html = (tmp_path / "page.html").read_text()
    inlined = json.loads(re.search(r"avmsfInlined = (.*?);</script>", html)[1])
    manifest = json.loads(base64.b64decode(inlined["manifest.json"]["base64"]))
    assert manifest["object"]["kind"] == "points"
    assert manifest["surface"] == {"kind": "mesh", "file": "surface.glb"}
    loaded = shown_mesh(base64.b64decode(inlined["surface.glb"]["base64"]))
    np.testing.assert_allclose(np.linalg.norm(loaded.vertices, axis=1), 0.1, rtol=1e-5)


def test_what_cannot_be_shown_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points, table = ball_points(), struck_table(shared=True)
    strikes = Impacts(torch.zeros(1, 3), torch.zeros(1, 5), 8000.0, ("a.wav",))
    with raises(ExportError, name="strikes", value=8000.0):
        make_bundle(table, strikes=strikes)
    with raises(ExportError, name="modes", value=0):
        make_bundle(replace(table, frequency=table.frequency[:0], damping=table.damping[:0], gains=table.gains[:, :0]))
    with raises(ExportError, file=tmp_path / "none.obj"):
        read_object(tmp_path / "none.obj", points)
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "torn.glb").write_bytes(b"glTF\x02\x00")
    for name, attribute in (("notes.txt", "suffix"), ("torn.glb", None)):
        with raises(ExportError, file=tmp_path / name, name=attribute):
            read_object(tmp_path / name, points)
    with raises(ExportError, name="center", value=pytest.approx(5.0, rel=1e-2)):
        read_object(replace(ball_surface(), vertices=ball_surface().vertices + torch.tensor([5.0, 0, 0])), points)
    (tmp_path / "huge.stl").touch()
    monkeypatch.setattr("avmsf.export.geometry.MAX_BYTES", -1)
    with raises(ExportError, file=tmp_path / "huge.stl", name="size", value=0):
        read_object(tmp_path / "huge.stl", points)
