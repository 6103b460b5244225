import sys

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from avmsf.capture.reconstruction import enclose, reconstruct_surface
from avmsf.capture.surface import Surface
from avmsf.errors import CaptureError

pytest.importorskip("skimage", reason="surfaces from points need scikit-image: pip install 'avmsf[fem]'")
pytest.importorskip("fast_simplification", reason="coarser surfaces need fast-simplification: pip install 'avmsf[fem]'")

RADIUS = 0.05
MIDDLE = torch.tensor([0.3, -0.2, 0.1])
CELLS = 48
"""A cell is 2 mm of the ball."""


def _ball(count: int = 4000, *, seed: int = 1) -> tuple[Tensor, Tensor]:
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    normals = torch.nn.functional.normalize(normals, dim=1)
    return MIDDLE + RADIUS * normals, normals


def _sampled(mesh: trimesh.Trimesh, count: int) -> tuple[Tensor, Tensor]:
    points, rows = trimesh.sample.sample_surface(mesh, count, seed=1)
    return torch.from_numpy(np.asarray(points)).float(), torch.from_numpy(mesh.face_normals[rows]).float()


def _mesh(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)


def _off(surface: Surface) -> Tensor:
    """Return how far the vertices lie off the ball, metres."""
    return ((surface.vertices - MIDDLE).norm(dim=1) - RADIUS).abs()


def test_a_ball_comes_back_closed_and_right_side_out() -> None:
    surface = reconstruct_surface(*_ball(), cells=CELLS)
    mesh = _mesh(surface)
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # A tenth of a cell of 2 mm.
    assert float(_off(surface).median()) < 2e-4
    assert float(_off(surface).max()) < 1e-3
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)


def test_a_ring_keeps_its_hole() -> None:
    ring = trimesh.creation.torus(major_radius=0.05, minor_radius=0.015, major_sections=64, minor_sections=32)
    mesh = _mesh(reconstruct_surface(*_sampled(ring, 6000), cells=64))
    assert mesh.is_watertight
    assert mesh.euler_number == 0
    assert mesh.volume == pytest.approx(ring.volume, rel=0.02)


def test_two_sides_of_a_thin_plate_stay_apart() -> None:
    # Four cells thick.
    plate = trimesh.creation.box((0.16, 0.12, 0.01))
    mesh = _mesh(reconstruct_surface(*_sampled(plate, 12000), cells=64))
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(plate.volume, rel=0.05)


def test_points_that_lie_denser_on_one_side_do_not_move_the_other() -> None:
    points, normals = _ball(24_000)
    kept = (points[:, 0] > MIDDLE[0]) | (torch.arange(len(points)) % 12 == 0)
    surface = reconstruct_surface(points[kept], normals[kept], cells=CELLS, blur=1.5)
    sparse = surface.vertices[:, 0] < MIDDLE[0]
    # Half a cell. Without weights of their own the sparse side's points enclose a twelfth of a body.
    assert float(_off(surface)[sparse].max()) < 1e-3
    assert _mesh(surface).is_watertight


def test_lengths_of_normals_and_the_unit_of_length_do_not_matter() -> None:
    points, normals = _ball()
    lengths = 0.1 + torch.rand(len(points), 1, generator=torch.Generator().manual_seed(2))
    metres = reconstruct_surface(points, normals, cells=CELLS)
    millimetres = reconstruct_surface(1000 * points, lengths * normals, cells=CELLS)
    assert torch.equal(metres.faces, millimetres.faces)
    torch.testing.assert_close(1000 * metres.vertices, millimetres.vertices, rtol=0, atol=2e-3)


def test_the_same_points_give_the_same_surface() -> None:
    one, other = (reconstruct_surface(*_ball(), cells=CELLS, faces=2000) for _ in range(2))
    assert torch.equal(one.vertices, other.vertices)
    assert torch.equal(one.faces, other.faces)


def test_fewer_triangles_are_still_the_ball() -> None:
    surface = reconstruct_surface(*_ball(), cells=CELLS, faces=1500)
    assert len(surface.faces) <= 1500
    assert _mesh(surface).is_watertight
    # The sagitta of triangles 5 mm wide is .1 mm.
    assert float(_off(surface).quantile(0.95)) < 4e-4


def test_noise_leaves_a_thick_body_closed_and_in_place() -> None:
    points, normals = _ball(8000)
    noise = 0.02 * 2 * RADIUS * torch.randn(points.shape, generator=torch.Generator().manual_seed(3))
    surface = reconstruct_surface(points + noise, normals, cells=CELLS, blur=2.0)
    assert _mesh(surface).is_watertight
    # Half of the noise's 2 mm.
    assert float(_off(surface).median()) < 1e-3


def test_specks_beside_the_body_are_left_out() -> None:
    values = np.zeros((40, 20, 20), dtype=np.float32)
    values[5:15, 5:15, 5:15] = 1.0
    values[30, 10, 10] = 1.0
    surface = enclose(values, 0.5, lowest=np.array([1.0, 2.0, 3.0]), spacing=0.1)
    # Half a cell around the solid ones.
    assert surface.vertices.amin(0).tolist() == pytest.approx([1.45, 2.45, 3.45])
    assert surface.vertices.amax(0).tolist() == pytest.approx([2.45, 3.45, 4.45])


def test_what_encloses_nothing_or_reaches_the_edge_is_refused() -> None:
    empty, full = np.zeros((8, 8, 8), dtype=np.float32), np.ones((8, 8, 8), dtype=np.float32)
    for values in (empty, full):
        with pytest.raises(CaptureError, match=r"enclose nothing at the level 0\.5"):
            enclose(values, 0.5, lowest=np.zeros(3), spacing=0.1)


def test_normals_that_point_inwards_are_refused() -> None:
    points, normals = _ball()
    with pytest.raises(CaptureError, match="turn them round"):
        reconstruct_surface(points, -normals, cells=CELLS)


def test_a_normal_without_length_is_named() -> None:
    points, normals = _ball()
    normals[[17, 30]] = 0.0
    with pytest.raises(CaptureError, match=r"normal 17 \(counted from 0\) has no length, nor have 1 others"):
        reconstruct_surface(points, normals)


def test_a_number_that_is_not_finite_is_named() -> None:
    points, normals = _ball()
    points[5, 1] = torch.nan
    with pytest.raises(CaptureError, match=r"point 5 \(counted from 0\)"):
        reconstruct_surface(points, normals)
    with pytest.raises(CaptureError, match=r"normal 8 \(counted from 0\)"):
        reconstruct_surface(_ball()[0], torch.where(torch.arange(4000)[:, None] == 8, torch.inf, normals))


def test_too_few_points_are_refused() -> None:
    with pytest.raises(CaptureError, match=r"expected 100 points .* or more, found 99"):
        reconstruct_surface(*_ball(99))


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_points_without_extent_are_refused(kept: int) -> None:
    points, normals = _ball()
    flat = torch.where(torch.arange(3) < kept, points, MIDDLE)
    with pytest.raises(CaptureError, match="in one place, on a line or in a plane"):
        reconstruct_surface(flat, normals)


def test_settings_that_give_no_grid_are_refused() -> None:
    for wrong in ({"cells": 8}, {"blur": 0.0}, {"faces": 2}):
        with pytest.raises(CaptureError, match=f"{next(iter(wrong))} = "):
            reconstruct_surface(*_ball(), **wrong)


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, package in (("skimage.measure", "scikit-image"), ("fast_simplification", "fast-simplification")):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            with pytest.raises(CaptureError, match=rf"need {package}.*pip install 'avmsf\[fem\]'"):
                reconstruct_surface(*_ball(), cells=CELLS, faces=1000)
