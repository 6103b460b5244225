from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from avmsf.capture.surface import Surface
from avmsf.errors import SceneError
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.gaussiansurface import gaussian_surface
from avmsf.scene.start import StartPoints, starting_cloud
from ball_views import MIDDLE, RADIUS, ball_cameras

CELLS = 40
"""A cell is 2.5 mm of the ball."""
DEEP, WIDE, WALL = 0.05, 0.05, 0.008
"""Height, outer radius and thickness of a cup, metres."""


def _ball(count: int = 3000, *, opacity: float = 0.95) -> GaussianCloud:
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    normals = torch.nn.functional.normalize(normals, dim=1)
    return _discs(torch.tensor(MIDDLE) + RADIUS * normals, normals, opacity=opacity)


def _discs(points: torch.Tensor, normals: torch.Tensor, *, opacity: float = 0.95) -> GaussianCloud:
    start = StartPoints(points, torch.full_like(points, 0.5), normals)
    return starting_cloud(start, degree=0, scale=1.0, opacity=opacity, flatness=0.1)


def _cup() -> trimesh.Trimesh:
    """Return an open cup that stands on z = 0."""
    outline = [(0, 0), (WIDE, 0), (WIDE, DEEP), (WIDE - WALL, DEEP), (WIDE - WALL, WALL), (0, WALL)]
    return trimesh.creation.revolve(np.array(outline), sections=64)


def _cup_cloud() -> GaussianCloud:
    points, rows = trimesh.sample.sample_surface(_cup(), 8000, seed=1)
    normals = torch.from_numpy(_cup().face_normals[rows]).float()
    return _discs(torch.from_numpy(np.asarray(points)).float(), normals)


def _mesh(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)


def _off(surface: Surface) -> torch.Tensor:
    """Return how far the vertices lie off the ball, metres."""
    return ((surface.vertices - torch.tensor(MIDDLE)).norm(dim=1) - RADIUS).abs()


@pytest.mark.parametrize("photographed", [True, False])
def test_a_ball_of_gaussians_is_a_closed_ball(photographed: bool) -> None:
    cameras = ball_cameras(24, size=128) if photographed else None
    surface = gaussian_surface(_ball(), cameras=cameras, cells=CELLS)
    mesh = _mesh(surface)
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # Half a cell.
    assert float(_off(surface).median()) < 1.25e-3
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.08)


def test_a_slender_bar_is_kept_from_end_to_end() -> None:
    """Thinner than two cells of as many as a ball has: a spoon's handle is."""
    sides = (0.2, 0.015, 0.003)
    bar = trimesh.creation.box(sides)
    points, rows = trimesh.sample.sample_surface(bar, 3000, seed=1)
    normals = torch.from_numpy(bar.face_normals[rows]).float()
    surface = gaussian_surface(_discs(torch.from_numpy(np.asarray(points)).float(), normals), cells=64)
    extent = surface.vertices.amax(0) - surface.vertices.amin(0)
    assert extent[0] == pytest.approx(sides[0], rel=0.05)
    assert _mesh(surface).is_watertight
    assert _mesh(surface).body_count == 1


def test_round_gaussians_need_no_normals() -> None:
    ball = _ball()
    round_ones = replace(ball, log_scales=ball.log_scales[:, :1].expand(-1, 3).clone())
    surface = gaussian_surface(round_ones, cells=CELLS)
    assert _mesh(surface).is_watertight
    assert float(_off(surface).median()) < 2.5e-3


def test_an_open_cup_keeps_its_wall() -> None:
    mesh, cup = _mesh(gaussian_surface(_cup_cloud(), cells=CELLS)), _cup()
    filled = np.pi * WIDE**2 * DEEP
    assert filled > 2.4 * cup.volume
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # Its wall is three cells thick; a quarter more is half a cell on each side.
    assert mesh.volume == pytest.approx(cup.volume, rel=0.25)
    assert not mesh.contains([[0.0, 0.0, 0.6 * DEEP]])[0]


def test_what_no_camera_looks_into_comes_out_filled() -> None:
    cameras = [camera for camera in ball_cameras(48, size=128) if abs(float(camera.position[2])) < 0.1]
    mesh = _mesh(gaussian_surface(_cup_cloud(), cameras=cameras, cells=CELLS))
    assert mesh.is_watertight
    assert mesh.contains([[0.0, 0.0, 0.3 * DEEP]])[0]


def test_the_same_gaussians_give_the_same_surface_with_no_more_triangles_than_asked() -> None:
    one, other = (gaussian_surface(_ball(), cells=CELLS, faces=1000) for _ in range(2))
    assert torch.equal(one.vertices, other.vertices)
    assert torch.equal(one.faces, other.faces)
    assert len(one.faces) <= 1000


def test_faint_gaussians_around_the_object_change_nothing() -> None:
    ball = _ball()
    haze = replace(ball, centers=torch.tensor(MIDDLE) + 2 * (ball.centers - torch.tensor(MIDDLE)))
    haze = replace(haze, logit_opacities=torch.full((len(ball),), -4.0))
    one, other = (gaussian_surface(each, cells=CELLS) for each in (ball, ball.join(haze)))
    assert torch.equal(one.vertices, other.vertices)


def test_transparent_gaussians_are_refused() -> None:
    with pytest.raises(SceneError, match=r"0 of 3000 Gaussians have an opacity of 0\.05 or more"):
        gaussian_surface(_ball(opacity=0.01))


def test_few_gaussians_are_refused() -> None:
    with pytest.raises(SceneError, match=r"99 of 99 Gaussians .* expected 100"):
        gaussian_surface(_ball(99))


def test_gaussians_in_one_place_are_refused() -> None:
    ball = _ball()
    with pytest.raises(SceneError, match="all 3000 Gaussians are in one place"):
        gaussian_surface(replace(ball, centers=torch.zeros_like(ball.centers)))


@pytest.mark.parametrize("name", ["centers", "rotations", "log_scales", "logit_opacities", "harmonics"])
def test_a_number_that_is_not_finite_is_named(name: str) -> None:
    ball = _ball()
    values = getattr(ball, name).clone()
    values[7] = torch.nan
    with pytest.raises(SceneError, match=f"found {name} .*nan.* of Gaussian 7"):
        gaussian_surface(replace(ball, **{name: values}))


def test_cameras_that_look_elsewhere_are_refused() -> None:
    ball = _ball()
    away = replace(ball, centers=ball.centers + 50.0)
    with pytest.raises(SceneError, match=r"none of 6 cameras has the Gaussians in its image.*units"):
        gaussian_surface(away, cameras=ball_cameras(6), cells=CELLS)


def test_no_cameras_at_all_are_refused() -> None:
    with pytest.raises(SceneError, match="none of 0 cameras"):
        gaussian_surface(_ball(), cameras=[], cells=CELLS)


def test_settings_that_give_no_surface_are_refused() -> None:
    for wrong in ({"faces": 3}, {"cells": 8}, {"agreement": 1.0}):
        with pytest.raises(SceneError, match=f"{next(iter(wrong))} = "):
            gaussian_surface(_ball(), **wrong)
