"""Surfaces made fit: what faces inwards is turned, noise goes, holes are measured, dense meshes are thinned."""

import math
from dataclasses import replace

import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem import meshing
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.fem.meshing import TOLERANCES, CheckedSurface, checked, denoised, roughness, simplified, thinned, weld
from avmsf.fem.remeshing import boundary_edges, mesh_of, remeshed
from avmsf.fem.tetrahedra import fill
from avmsf.mesh.level_set import Grid, enclose
from avmsf.mesh.queries import ClosestPoints
from avmsf.mesh.surface import Surface
from factories.looked_at import surface_of
from factories.made_sheet import sheet_over
from factories.raising import raises


def welded(mesh: Trimesh) -> Trimesh:
    return weld(surface_of(mesh))


def cup(below: float) -> Trimesh:
    """Return the part of a ball of radius 1 below this height."""
    angles = np.linspace(0.0, math.acos(-below), 40)
    return welded(trimesh.creation.revolve(np.stack([np.sin(angles), -np.cos(angles)], axis=1), sections=64))


def test_an_inverted_part_is_turned_and_the_wall_of_a_void_is_not():
    outer, inner, beside = (trimesh.creation.icosphere(2, radius=radius) for radius in (1.0, 0.8, 0.5))
    inner.invert()
    beside.apply_translation((3.0, 0.0, 0.0))
    beside.invert()
    truth = (1.0 - 0.8**3 + 0.5**3) * trimesh.creation.icosphere(2).volume
    messages: list[str] = []
    found = checked(surface_of(trimesh.util.concatenate([outer, inner, beside])), log=messages.append)
    assert found.mesh.volume == pytest.approx(truth, rel=1e-5)
    assert len(messages) == 1
    # All of it inside out: the void goes with the body around it.
    every = trimesh.util.concatenate([outer, inner])
    every.invert()
    assert checked(surface_of(every), log=messages.append).mesh.volume == pytest.approx(
        (1.0 - 0.8**3) * trimesh.creation.icosphere(2).volume, rel=1e-5
    )


@pytest.mark.parametrize(("below", "vessel"), [(0.05, True), (0.9, True), (-0.995, False)])
def test_an_open_vessel_that_faces_inwards_is_told_and_stays(below: float, vessel: bool):
    mesh = cup(below)
    outwards = surface_of(mesh)
    for surface, expected in ((outwards, False), (Surface(outwards.vertices, outwards.faces.flip(1)), vessel)):
        messages: list[str] = []
        found = checked(surface, log=messages.append).mesh
        # A dish a twentieth as deep as its radius has no inside worth the name.
        assert any("inwards" in message for message in messages) == expected
        assert (found.volume > 0) == (weld(surface).volume > 0)


def test_lids_are_measured_as_they_would_close_the_holes():
    half = CheckedSurface(cup(0.05))
    # The disc on a dome of height h on a ball of radius 1 is (2 - h) / (4 - h) of all.
    assert half.lids == pytest.approx((2 - 1.05) / (4 - 1.05), abs=0.005)
    with raises(SimulationError, name="mesh", value=half.lids):
        half.expect_filling()
    assert half.mean_thickness is None
    nearly = CheckedSurface(cup(0.9))
    nearly.expect_filling()
    held = nearly.mean_thickness
    assert held is not None
    assert held == pytest.approx(2 * 4 / 3 * math.pi / (4 * math.pi), rel=0.05)


def test_no_wall_is_guessed_where_the_surface_holds_little_more_than_it():
    whole = CheckedSurface(welded(trimesh.creation.icosphere(4)))
    # Twice the volume over the area is two thirds of the radius, of which a wall may be a sixth.
    whole.expect_wall(0.110, guessed=True)
    with raises(SimulationError, name="wall", value=0.112):
        whole.expect_wall(0.112, guessed=True)
    CheckedSurface(cup(0.05)).expect_wall(0.3, guessed=True)


def test_noise_is_taken_out_of_a_mesh_by_as_much_as_it_has():
    clean = welded(trimesh.creation.icosphere(4))
    for part in (0.01, 0.02):
        noise = part * clean.scale * np.random.default_rng(0).standard_normal(clean.vertices.shape) / math.sqrt(3)
        found, moved = denoised(mesh_of(clean.vertices + noise, clean.faces))
        assert moved == pytest.approx(part * clean.scale, rel=0.1)
        surface = ClosestPoints(clean.triangles)
        before = np.sqrt((surface(clean.vertices + noise).distances ** 2).mean())
        assert np.sqrt((surface(found.vertices).distances ** 2).mean()) < 0.35 * before
        assert roughness(found) < 8.0
        whole = checked(surface_of(mesh_of(clean.vertices + noise, clean.faces)), log=lambda words: None)
        assert roughness(whole.mesh) < 8.0
        assert found.volume == pytest.approx(mesh_of(clean.vertices + noise, clean.faces).volume, rel=1e-9)


def test_what_is_not_noisy_stays_as_it_is():
    box = welded(trimesh.creation.box((1.0, 0.2, 0.01)))
    for mesh in (box, remeshed(box, 0.03), welded(trimesh.creation.icosphere(4)), cup(0.3)):
        assert roughness(mesh) < TOLERANCES.min_roughness_deg
        found, moved = denoised(mesh)
        assert found is mesh
        assert moved == 0.0


def test_a_rough_form_that_is_no_noise_stays():
    # Each vertex lies on a wave that its neighbors predict, though triangles turn by more than noise would make them.
    side = np.linspace(0, 1, 49)
    waves = weld(sheet_over(side, side, lambda x, y: 0.12 * np.sin(12 * math.pi * x) * np.sin(12 * math.pi * y)))
    assert roughness(waves) > TOLERANCES.min_roughness_deg
    assert denoised(waves)[0] is waves


def test_corners_a_millionth_of_the_size_apart_are_one() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    corners = np.array(ball.triangles).reshape(-1, 3)
    corners += 1e-7 * np.random.default_rng(0).uniform(-1, 1, corners.shape)
    faces = torch.arange(len(corners)).reshape(-1, 3)
    mesh = weld(Surface(torch.from_numpy(corners), faces))
    assert (len(mesh.vertices), len(mesh.faces)) == (len(ball.vertices), len(ball.faces))


def limit(monkeypatch: pytest.MonkeyPatch, triangles: int) -> None:
    monkeypatch.setattr(meshing, "TOLERANCES", replace(TOLERANCES, max_faces=triangles, enough_faces=triangles))


def ellipsoid(subdivisions: int) -> Trimesh:
    """Return one with half axes of 60, 45 and 30 mm."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return mesh_of(np.array(mesh.vertices) * [0.060, 0.045, 0.030], np.array(mesh.faces))


def vessel(sections: int) -> Trimesh:
    """Return the part of a ball of 5 cm from its bottom to 115 degrees."""
    angles = np.linspace(0.0, 2.0, sections // 2)
    mesh = trimesh.creation.revolve(0.05 * np.stack([np.sin(angles), -np.cos(angles)], axis=1), sections=sections)
    return welded(mesh)


@pytest.mark.slow
@pytest.mark.parametrize(("dense", "coarse"), [(ellipsoid(5), ellipsoid(4)), (vessel(160), vessel(70))])
def test_a_dense_mesh_vibrates_as_a_coarse_one_of_the_same_shape(dense, coarse, monkeypatch):
    # Those that the wall is made of are far fewer.
    limit(monkeypatch, 6000)
    found, known = (
        CandidateBodies(surface_of(mesh), thicknesses=[0.002], count=4, dofs=8000).bodies[0].elastic
        for mesh in (dense, coarse)
    )
    # Without thinning, elements that differ change frequencies by 1.5 % at this size.
    assert found.frequency.numpy() == pytest.approx(known.frequency.numpy(), rel=0.03)
    assert found.mass == pytest.approx(known.mass, rel=0.01)


def test_a_thinned_sheet_keeps_its_rim(monkeypatch: pytest.MonkeyPatch) -> None:
    side = np.linspace(0.0, 1.0, 61)
    sheet = weld(sheet_over(side, side))
    limit(monkeypatch, 1000)
    found = thinned(sheet, log=lambda words: None)
    assert len(found.faces) <= 1000
    # Each corner may lose a triangle, with sides of about .045 now.
    assert found.area == pytest.approx(1.0, abs=4 * 0.045**2 / 2)
    assert np.ptp(found.vertices, axis=0) == pytest.approx([1.0, 1.0, 0.0], abs=1e-6)
    assert 0 < len(boundary_edges(found)) < len(boundary_edges(sheet))


def test_more_triangles_are_left_where_fewer_would_tear_the_skin(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = ellipsoid(4)

    def tearing(points: np.ndarray, faces: np.ndarray, *, target_count: int) -> tuple[np.ndarray, np.ndarray]:
        return points, faces if target_count >= 4000 else faces[:target_count]

    monkeypatch.setattr(fast_simplification, "simplify", tearing)
    limit(monkeypatch, 1000)
    found = thinned(ball, log=lambda words: None)
    assert np.array_equal(found.faces, ball.faces)
    limit(monkeypatch, 3000)
    assert thinned(ball, log=lambda words: None) is ball


def test_a_knotted_skin_shares_a_few_edges_rather_than_keep_its_triangles_and_is_filled() -> None:
    values = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((40, 40, 40)), 2.0)
    values /= values.std()
    radius = np.linalg.norm(np.meshgrid(*[np.linspace(-1, 1, 40)] * 3), axis=0)
    sponge = np.minimum(values + 0.5, 4 * (0.85 - radius)).astype(np.float32)
    mesh = weld(enclose(sponge, Grid(np.zeros(3), 0.01, sponge.shape)))
    assert len(simplified(mesh, 1000).faces) > 10_000
    found = simplified(mesh, 1000, most=4000)
    assert len(found.faces) <= 1000
    assert len(boundary_edges(found)) == 0
    assert found.volume == pytest.approx(mesh.volume, rel=0.02)
    filled = fill(surface_of(found), detail=0.15)
    assert float(filled.volumes.sum()) == pytest.approx(mesh.volume, rel=0.05)


def test_a_sheet_is_thinned_alike_wherever_it_lies():
    side = np.linspace(0, 0.1, 200)
    sheet = sheet_over(side, side, lambda x, y: 8e-4 * np.sin(1047 * x) * np.sin(1047 * y))
    points, faces = sheet.vertices.double().numpy(), sheet.faces.numpy()
    moved = (trimesh.Trimesh(points + np.array([0.0, 0.0, z]), faces, process=False) for z in (0.0, 0.5))
    assert len({len(thinned(each, log=lambda _: None).faces) for each in moved}) == 1
