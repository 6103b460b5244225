"""Shapes of what Gaussians show, without photographs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.pipeline.cloud_shape import shape_of_cloud
from factories.ball_views import MIDDLE, RADIUS
from factories.raising import raises

CELLS = 48


def _ball(count: int = 3000, *, opacity: float = 0.95) -> GaussianCloud:
    normals = torch.randn(count, 3, generator=torch.Generator().manual_seed(1))
    normals = torch.nn.functional.normalize(normals, dim=1)
    return _discs(torch.tensor(MIDDLE) + RADIUS * normals, normals, opacity=opacity)


def _discs(points: torch.Tensor, normals: torch.Tensor, *, opacity: float = 0.95) -> GaussianCloud:
    start = StartPoints(points, torch.full_like(points, 0.5), normals)
    return starting_cloud(start, degree=0, scale=1.0, opacity=opacity, flatness=0.1)


@pytest.mark.slow
def test_a_ball_of_gaussians_is_a_closed_ball() -> None:
    surface = shape_of_cloud(_ball(), cells=CELLS).as_seen()
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert mesh.is_watertight
    off = np.abs(np.linalg.norm(mesh.vertices - np.array(MIDDLE), axis=1) - RADIUS)
    assert np.median(off) < 0.03 * RADIUS


@pytest.mark.slow
def test_a_slender_bar_is_kept_from_end_to_end() -> None:
    sides = (0.2, 0.015, 0.003)
    bar = trimesh.creation.box(sides)
    points, rows = trimesh.sample.sample_surface(bar, 3000, seed=1)
    normals = torch.from_numpy(bar.face_normals[rows]).float()
    surface = shape_of_cloud(_discs(torch.from_numpy(np.asarray(points)).float(), normals), cells=CELLS).as_seen()
    assert float(surface.vertices[:, 0].max() - surface.vertices[:, 0].min()) == pytest.approx(sides[0], rel=0.05)
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    assert mesh.body_count == 1


@pytest.mark.slow
def test_faint_gaussians_around_the_object_change_nothing() -> None:
    ball = _ball()
    haze = replace(ball, centers=torch.tensor(MIDDLE) + 2 * (ball.centers - torch.tensor(MIDDLE)))
    haze = replace(haze, logit_opacities=torch.full((len(ball),), -4.0))
    one, other = (shape_of_cloud(each, cells=CELLS).as_seen() for each in (ball, ball.join(haze)))
    assert torch.equal(one.vertices, other.vertices)


@pytest.mark.parametrize("name", ["centers", "rotations", "log_scales", "logit_opacities", "harmonics"])
def test_a_number_that_is_not_finite_is_named(name: str) -> None:
    ball = _ball()
    values = getattr(ball, name).clone()
    values[7] = torch.nan
    with raises(SceneError, name=name, row=7):
        shape_of_cloud(replace(ball, **{name: values}))


def test_gaussians_that_show_no_object_are_refused() -> None:
    ball = _ball()
    in_one_place = replace(ball, centers=torch.zeros_like(ball.centers))
    for wrong, name in ((_ball(opacity=0.01), "opacities"), (_ball(99), "opacities"), (in_one_place, "centers")):
        with raises(SceneError, name=name):
            shape_of_cloud(wrong)
