"""A table of points sounds as its field, and what a page reads is the field and the object beside it."""

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
from avmsf.editing.modal_edit import adjust_modes
from avmsf.errors import AvmsfError, ExportError
from avmsf.export.geometry import read_object
from avmsf.export.sampled_field import SampledField, outward_normals
from avmsf.export.web import make_bundle, write_webpage
from avmsf.field.config import FitConfig
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SUPPORTING, Origin, SoundField
from avmsf.gaussians.ply import write_splats
from avmsf.mesh.surface import Surface
from avmsf.modal.modes import ForcePulse, ModalBank
from avmsf.modal.residual_noise import Residual
from factories.clouds import random_cloud
from factories.looked_at import surface_of
from factories.made_fields import BANK, FIELDS, elastic, mixture, places, plate, positional
from factories.made_tables import STRUCK_RATE as RATE
from factories.made_tables import read_arrays, struck_table
from factories.raising import raises

SAMPLES = 3000


def sounding(
    name: str, *, phase: float = 0.0, scaled: bool = False, background_force: float | None = None
) -> SoundField:
    gains = FIELDS[name]()
    if scaled:
        gains = ScaledGains(gains, torch.linspace(0.5, 2.0, len(BANK), dtype=torch.float64), length=1.25)
    magnitude = torch.linspace(0.02, 0.0, 33)
    origin = Origin("plate", ("a.wav",), per_newton=True, config=FitConfig(seed=7))
    phases, residual = torch.full((len(BANK),), phase, dtype=torch.float64), Residual(magnitude, force=background_force)
    return SoundField(BANK, gains, phases, residual, 8000.0, SAMPLES, origin)


def test_points_may_be_arrays_and_lists():
    made = sounding("positional")
    places = made.gain_field.points[:3]
    found = [SampledField.of(made, each).gains for each in (places, places.numpy(), places.tolist())]
    assert torch.equal(found[0], found[1])
    torch.testing.assert_close(found[0], found[2])


def test_without_a_body_normals_oppose_the_impacts_whose_gains_are_written():
    made = sounding("directional")
    table = SampledField.of(made, limit=40)
    against = made.complex_gains(table.points, directions=-table.normals)
    torch.testing.assert_close(against, made.complex_gains(table.points), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize(
    ("phase", "scaled", "pulse", "background_force"),
    [(0.0, False, None, 5.0), (0.7, False, ForcePulse(1e-3, "hertz"), None), (0.7, True, None, None)],
)
def test_a_blow_sounds_as_the_fields(name, phase, scaled, pulse, background_force):
    sound_field = sounding(name, phase=phase, scaled=scaled, background_force=background_force)
    table = SampledField.of(sound_field)
    rows = torch.tensor([0, 17, 149])
    for force in (None, 2.5):
        expected = sound_field.render(table.points[rows], forces=force, pulse=pulse)
        error = (table.render(rows, force=force, pulse=pulse) - expected).abs().max() / expected.abs().max()
        assert float(error) < 1e-5
    assert table.shared_damping == (name != "attention with dampings")


@pytest.mark.parametrize("scaled", [False, True])
def test_normals_of_an_elastic_model_are_its_bodys(scaled):
    table = SampledField.of(sounding("elastic", scaled=scaled))
    torch.testing.assert_close(table.normals, plate().normals(elastic().points).float())


def test_given_points_are_kept_and_fewer_are_the_fields_own_spread_out():
    chosen, normals = places(5, seed=9), torch.tensor([[0.0, 0.0, 2.0]]).expand(5, 3)
    given = SampledField.of(sounding("positional"), chosen, normals)
    assert torch.equal(given.points, chosen)
    torch.testing.assert_close(given.normals, normals / 2)
    assert (given.name, given.per_newton) == ("plate", True)
    table = SampledField.of(sounding("attention with dampings"))
    few = table.take(table.spread(9))
    rows = table.nearest(few.points)
    torch.testing.assert_close(few.render(torch.arange(9)), table.render(rows))
    torch.testing.assert_close(few.damping, table.damping[rows])
    table = SampledField.of(sounding("positional"), limit=12)
    own = positional().points
    assert len(table) == 12
    assert bool((table.points[:, None] == own).all(2).any(1).all())
    # Of 150 points, twelve at random lie closer: a plate of .24 x .17 m holds twelve about 6 cm apart.
    apart = torch.cdist(table.points, table.points) + torch.eye(12)
    assert float(apart.min()) > 0.04


def ball(count: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(drawn, dim=1)


def test_normals_point_outwards():
    out, far = ball(2000), torch.tensor([5.0, 0.0, 0.0])
    # Of two balls, each has its own outside.
    assert float((outward_normals(torch.cat([out, out + far])) * torch.cat([out, out])).sum(1).min()) > 0.9
    bowl = out[out[:, 2] < -0.3]
    assert float((outward_normals(bowl) * bowl).sum(1).median()) > 0.95
    two = outward_normals(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0]]))
    assert two.tolist() == [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("given", "name", "value"),
    [
        ({"points": torch.zeros(0, 3)}, "points", 0),
        ({"points": torch.tensor([[0.0, 0.0, torch.nan]])}, "points", 1),
        ({"points": places(5, seed=9), "normals": torch.ones(4, 3)}, "normals", 4),
        ({"limit": 0}, "limit", 0),
    ],
)
def test_what_cannot_be_sampled_is_refused(given, name, value):
    with raises(ExportError, name=name, value=value):
        SampledField.of(sounding("positional"), **given)
    with raises(ExportError, name="modes", value=0):
        SampledField.of(adjust_modes(sounding("positional"), pitch=900.0))


def test_normals_of_a_few_contacts_are_those_of_the_surface():
    out = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    values = torch.randn(20, len(BANK), generator=torch.Generator().manual_seed(1), dtype=torch.complex128)
    gains = mixture(Sites(0.1 * out[:20].double(), -out[:20].double()), values, directional=False, points=0.1 * out)
    for limit in (1, 16):
        table = SampledField.of(replace(sounding("positional"), gain_field=gains), limit=limit)
        assert float((10 * table.points * table.normals).sum(1).min()) > 0.95


def test_supporting_poles_are_counted_among_the_modes_that_sound():
    made = sounding("positional")
    report = {SUPPORTING: [1, 4]}
    # Twice as high, the last mode is beyond half the sample rate.
    bank = ModalBank(2.0 * BANK.frequency, BANK.damping)
    field = replace(made, bank=bank, origin=replace(made.origin, report=report))
    assert field.is_mode.tolist() == [True, False, True, True, False]
    table = SampledField.of(field)
    assert len(table.frequency) == 4
    assert table.supporting == table.take(torch.tensor([3])).supporting == (1,)
    assert table.frequency.tolist() == bank.frequency[:4].tolist()
    expected = field.render(table.points[:3])
    torch.testing.assert_close(table.render(torch.arange(3)), expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    assert make_bundle(table).manifest["supporting"] == [1]
    assert SampledField.of(made).supporting == ()


@pytest.mark.parametrize("shared", [True, False])
def test_tensors_are_the_tables_to_the_last_bit(tmp_path: Path, shared: bool) -> None:
    table = struck_table(shared=shared, points=5, modes=3, seconds=0.0300625)
    written = write_webpage(table, tmp_path / "page")
    found = read_arrays(tmp_path / "page", "tensors")
    parts = {"sine": table.gains.real, "cosine": table.gains.imag}
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    for name in ("points", "normals", "frequency", "damping", "sine", "cosine", "noise"):
        expected = parts[name] if name in parts else getattr(table, name)
        assert found[name].dtype == expected.dtype
        assert torch.equal(found[name], expected), name
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
    write_webpage(struck_table(shared=True), tmp_path / "page", strikes=strikes)
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    assert [each["name"] for each in manifest["strikes"]] == ["a.wav", "../b.wav"]
    assert [each["sound"] for each in manifest["strikes"]] == ["strikes/001.wav", "strikes/002.wav"]
    assert manifest["strikes"][1]["contact"] == [0.0, 0.1, 0.0]
    assert manifest["strikes"][1]["direction"] == [0.0, -1.0, 0.0]
    for row, each in enumerate(manifest["strikes"]):
        sound, rate = soundfile.read(tmp_path / "page" / each["sound"], dtype="float32")
        assert rate == RATE
        assert np.array_equal(sound, sounds[row].numpy())


def ball_surface(divisions: int = 2) -> Surface:
    return surface_of(trimesh.creation.icosphere(subdivisions=divisions, radius=0.1))


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
    write_webpage(ball_table(), tmp_path / "page", object=tmp_path / "ball.ply")
    assert (tmp_path / "page" / "object.ply").read_bytes() == (tmp_path / "ball.ply").read_bytes()
    manifest = json.loads((tmp_path / "page" / "manifest.json").read_text())
    assert manifest["object"] == {"kind": "gaussians", "file": "object.ply"}
    (tmp_path / "short.ply").write_bytes((tmp_path / "ball.ply").read_bytes()[:-100])
    with raises(AvmsfError, file="short.ply"):
        read_object(tmp_path / "short.ply", points)


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


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    points, table = ball_points(), struck_table(shared=True)
    strikes = Impacts(torch.zeros(1, 3), torch.zeros(1, 5), 8000.0, ("a.wav",))
    with raises(ExportError, name="strikes", value=8000.0):
        make_bundle(table, strikes=strikes)
    with raises(ExportError, file=tmp_path / "none.obj"):
        read_object(tmp_path / "none.obj", points)
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "torn.glb").write_bytes(b"glTF\x02\x00")
    for name, attribute in (("notes.txt", "suffix"), ("torn.glb", None)):
        with raises(ExportError, file=tmp_path / name, name=attribute):
            read_object(tmp_path / name, points)
    with raises(ExportError, name="center", value=pytest.approx(5.0, rel=1e-2)):
        read_object(replace(ball_surface(), vertices=ball_surface().vertices + torch.tensor([5.0, 0, 0])), points)
