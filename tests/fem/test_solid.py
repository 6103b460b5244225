"""Tetrahedra: their volume, their outside, and bodies made of meshes that are closed, open or broken."""

import importlib.util
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem import tetrahedra
from avmsf.fem.meshing import weld
from avmsf.fem.remeshing import boundary_edges, coarsened, remeshed
from avmsf.fem.solid import Solid
from avmsf.fem.tetrahedra import fill
from avmsf.fem.walls import shell
from avmsf.mesh.queries import ClosestPoints
from avmsf.mesh.surface import Surface
from factories.looked_at import mesh_of, sphere, surface_of
from factories.raising import raises
from oracles.block import block


def half(surface: Surface) -> Surface:
    middles = surface.vertices[surface.faces].mean(dim=1)
    return Surface(surface.vertices, surface.faces[middles[:, 2] < 0])


def skin_of(solid: Solid) -> Trimesh:
    return Trimesh(solid.points.numpy(), solid.boundary.numpy(), process=False)


def test_the_boundary_is_closed_and_looks_outwards():
    solid = block((0.2, 0.1, 0.05), (3, 2, 2))
    assert solid.volume == pytest.approx(0.2 * 0.1 * 0.05, rel=1e-12)
    # What the outside encloses is what the cells fill, with a minus if it looked inwards.
    assert skin_of(solid).volume == pytest.approx(solid.volume, rel=1e-12)
    assert skin_of(solid).is_watertight
    assert solid.size == pytest.approx(math.sqrt(0.04 + 0.01 + 0.0025), rel=1e-12)
    assert mesh_of(solid.surface).volume == pytest.approx(solid.volume, rel=1e-6)


def test_cells_are_turned_and_unused_points_left_out():
    points = torch.tensor([[9.0, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    solid = Solid.build(points, torch.tensor([[1, 3, 2, 4]]))
    assert len(solid.points) == 4
    assert solid.volumes.tolist() == [pytest.approx(1 / 6)]


def test_parts_are_counted_by_shared_sides_largest_first():
    small, large = block((0.1, 0.1, 0.1), (1, 1, 1)), block((0.2, 0.2, 0.2), (1, 1, 1))
    # The two meet in one corner only.
    points = torch.cat([small.points - 0.1, large.points])
    both = Solid.build(points, torch.cat([small.cells, large.cells + len(small.points)]))
    assert both.parts.tolist() == [1] * 6 + [0] * 6


def test_closest_points_are_those_of_trimesh():
    mesh = trimesh.creation.torus(0.04, 0.015, major_sections=12, minor_sections=6)
    # One long triangle beside many small ones; and single ones, as a neighbor would stand in for a side left out.
    long = [[[0.0, 0.0, 0.1], [1.0, 0.0, 0.1], [1.0, 0.001, 0.1]]]
    random = np.random.default_rng(0)
    for triangles in (np.concatenate([mesh.triangles, long]), *random.uniform(-0.1, 0.1, (20, 1, 3, 3))):
        search, places = ClosestPoints(triangles), random.uniform(-0.2, 0.2, (40, 3))
        assert len(search(places[:0]).rows) == 0
        found = search(places)
        soup = Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
        expected, distances, _ = trimesh.proximity.closest_point_naive(soup, places)
        np.testing.assert_allclose(found.distances, distances, atol=1e-12)
        assert (found.weights >= 0).all()
        np.testing.assert_allclose(found.weights.sum(axis=1), 1.0, rtol=1e-12)
        at = np.einsum("pc,pcd->pd", found.weights, triangles[found.rows])
        np.testing.assert_allclose(at, expected, atol=1e-12)


def test_threads_that_share_a_search_get_what_they_asked_for():
    search, interval = ClosestPoints(trimesh.creation.box().triangles), sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)
        with ThreadPoolExecutor(2) as pool:
            found = list(pool.map(lambda count: len(search(np.zeros((count, 3))).rows), 6_000 * (3, 5)))
    finally:
        sys.setswitchinterval(interval)
    assert found == 6_000 * [3, 5]


def test_a_coarser_skin_keeps_its_volume_and_stays_closed():
    mesh = weld(sphere())
    coarse = remeshed(mesh, 0.02)
    assert len(coarse.faces) < 0.3 * len(mesh.faces)
    assert len(boundary_edges(coarse)) == 0
    # Triangles with sides of up to 3 cm lie within 3 mm of a sphere of 5 cm, 6 % of its radius.
    assert 0.82 * mesh.volume < coarse.volume < mesh.volume
    np.testing.assert_allclose(np.linalg.norm(coarse.vertices, axis=1), 0.05, rtol=1e-5)


def test_a_coarser_sheet_keeps_its_hole():
    grid = block((0.1, 0.1, 0.1), (4, 4, 4))
    flat = grid.boundary[(grid.points[grid.boundary][:, :, 2] == 0).all(dim=1)]
    middle = (grid.points[flat].mean(dim=1) - torch.tensor([0.04, 0.04, 0.0])).norm(dim=1).argmin()
    sheet = weld(Surface(grid.points.float(), flat[torch.arange(len(flat)) != middle]))
    # Longer than the hole, which is a triangle: to take out one of its edges would sew it up.
    coarse = coarsened(sheet, 0.06, turn=0.7)
    assert len(coarse.faces) < len(sheet.faces)
    # That of a sheet with a hole.
    assert coarse.euler_number == 0
    assert coarse.area == pytest.approx(sheet.area, rel=1e-6)


class WithoutNormals(Trimesh):
    """A mesh whose normals say nothing."""

    @property
    def vertex_normals(self) -> np.ndarray:
        return np.zeros(self.vertices.shape)


def test_a_coarser_ring_stays_a_ring():
    ring = weld(surface_of(trimesh.creation.torus(0.05, 0.008, major_sections=24, minor_sections=8)))
    # Edges longer than the tube is round, and no normals: nothing but its topology keeps it from being pinched.
    found = coarsened(WithoutNormals(ring.vertices, ring.faces, process=False), 0.06, turn=-1.0)
    assert len(found.faces) < 0.5 * len(ring.faces)
    assert found.is_watertight
    # That of a ring.
    assert found.euler_number == 0


def test_an_open_bowl_gets_a_wall():
    sheet = half(sphere())
    solid = shell(sheet, thickness=0.003, detail=0.06)
    # Inwards of 5 cm, so between the spheres of 4.7 and 5; facets lie a little inside both.
    assert solid.volume == pytest.approx(2 / 3 * math.pi * (0.05**3 - 0.047**3), rel=0.08)
    radii = solid.points.norm(dim=1)
    assert 0.0468 < float(radii.min()) < 0.0472
    assert float(radii.max()) == pytest.approx(0.05, abs=1e-6)
    assert skin_of(solid).is_watertight
    assert int(solid.parts.max()) == 0


def test_a_hollow_ball_has_two_surfaces():
    solid = shell(sphere(), thickness=0.004, detail=0.06)
    assert solid.volume == pytest.approx(4 / 3 * math.pi * (0.05**3 - 0.046**3), rel=0.08)
    # Two closed surfaces of Euler characteristic 2.
    assert skin_of(solid).is_watertight
    assert skin_of(solid).euler_number == 4


def mixed(surface: Surface) -> Surface:
    """Turn every other triangle round."""
    faces = surface.faces.clone()
    faces[::2] = faces[::2].flip(1)
    return Surface(surface.vertices, faces)


@pytest.mark.slow
def test_a_skin_that_runs_through_itself_is_filled_once():
    # A tube wider than the ring that it is bent to: the part around the axis lies inside of it twice.
    ring, tube = 0.03, 0.04
    spindle = surface_of(trimesh.creation.torus(ring, tube, major_sections=48, minor_sections=32))
    solid = fill(spindle, detail=0.08)
    # Discs out to the tube's outer side, less the dimples above and below the part that is inside twice.
    heights = np.linspace(-tube, tube, 2001)
    half_chord = np.sqrt(tube**2 - heights**2)
    dimples = np.where(half_chord < ring, ring - half_chord, 0.0)
    volume = np.trapezoid(math.pi * ((ring + half_chord) ** 2 - dimples**2), heights)
    assert solid.volume == pytest.approx(volume, rel=0.05)
    assert int(solid.parts.max()) == 0


def test_triangles_that_face_different_ways_are_filled_all_the_same():
    solid = fill(mixed(sphere()), detail=0.1)
    assert solid.volume == pytest.approx(4 / 3 * math.pi * 0.05**3, rel=0.06)


def apart(surface: Surface) -> Surface:
    vertices = torch.cat([surface.vertices, surface.vertices + 0.2])
    return Surface(vertices, torch.cat([surface.faces, surface.faces + len(surface.vertices)]))


TRIANGLE, CELL = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1, 2, 3]])
NAN = pytest.approx(math.nan, nan_ok=True)


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (lambda: Solid.build(torch.full((4, 3), math.nan).double(), CELL), "cells", NAN),
        (lambda: Solid.build(torch.eye(4, 3).double()[[0, 1, 2, 2]], CELL), "cells", 0.0),
        # Too thick for the surface.
        (lambda: shell(sphere(), thickness=0.02), "thickness", 0.02),
        (lambda: shell(half(sphere()), thickness=0.06), "thickness", 0.06),
        (lambda: shell(Surface(torch.rand(9, 3), TRIANGLE[:0]), thickness=0.001), "faces", 0),
        (lambda: shell(Surface(torch.zeros(3, 3), TRIANGLE), thickness=0.001), "areas", 0.0),
        (lambda: shell(mixed(sphere()), thickness=0.001), "normals", pytest.approx(0.5, abs=0.3)),
        (lambda: fill(half(sphere()), detail=0.2), "holes", pytest.approx(1 / 3, abs=0.09)),
        (lambda: fill(Surface(0.1 * torch.eye(3), TRIANGLE), detail=0.2), "volume", 0),
        (lambda: fill(apart(sphere(subdivisions=1)), detail=0.2), "parts", 2),
        (lambda: fill(sphere(subdivisions=1), timeout=0.01), "timeout", 0.01),
    ],
)
def test_what_is_no_body_is_refused(call, name, value):
    with raises(SimulationError, name=name, row=0 if name == "cells" else None, value=value):
        call()


def test_a_mesh_has_the_same_tetrahedra_each_time_and_a_damaged_copy_is_made_again(monkeypatch, tmp_path):
    monkeypatch.setenv("AVMSF_CACHE", str(tmp_path))
    first, second = fill(sphere(subdivisions=2), detail=0.2), fill(sphere(subdivisions=2), detail=0.2)
    assert torch.equal(first.points, second.points)
    assert torch.equal(first.cells, second.cells)
    (stored,) = (tmp_path / "tetrahedra").iterdir()
    for length in (100, 0):
        stored.write_bytes(stored.read_bytes()[:length])
        assert fill(sphere(subdivisions=2), detail=0.2).volume == pytest.approx(first.volume, rel=0.05)


@pytest.mark.skipif(not Path("/proc/self/fdinfo").exists(), reason="sees by /proc when the worker has begun")
def test_a_filling_ends_when_its_parent_does(tmp_path):
    mesh, library = sphere(subdivisions=4), Path(importlib.util.find_spec("pytetwild").origin).parent
    points, faces = mesh.vertices.double().numpy(), mesh.faces.numpy().astype(np.uint32)
    settings = {"edge": 0.005, "envelope": 1e-4, "library": str(library), "seconds": 60.0}
    np.savez(tmp_path / "job.npz", points=points, faces=faces, **settings)
    command = [sys.executable, "-P", str(tetrahedra.WORKER), "job.npz", "result.npz"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, cwd=tmp_path) as worker:
        flags = Path(f"/proc/{worker.pid}/fdinfo/0")
        end = time.monotonic() + 60.0
        while not int(flags.read_text().split()[3], 8) & os.O_ASYNC and time.monotonic() < end:
            time.sleep(0.05)
        # What a dying parent leaves behind: its end of the pipe, closed.
        worker.stdin.close()
        assert worker.wait(30) == -signal.SIGIO


def test_a_crash_of_pytetwild_is_reported(monkeypatch, tmp_path):
    crashing = tmp_path / "worker.py"
    crashing.write_text("import os; os.abort()")
    monkeypatch.setattr(tetrahedra, "WORKER", crashing)
    with raises(SimulationError, name="pytetwild", value=-6):
        fill(sphere(subdivisions=1))
