"""Gaussians as shapes: without photographs, without what is far away, moved onto a mesh, and of an object's folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.datasets import CaptureCollection
from avmsf.errors import SceneError
from avmsf.evaluation.objects import ObjectInputs
from avmsf.features.feature_field import FeatureField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats
from avmsf.mesh import Surface
from avmsf.pipeline.cloud_shape import shape_of_cloud
from avmsf.pipeline.scene import without_far
from avmsf.pipeline.shape import OFF_MESH, moved_onto
from factories.ball_views import MIDDLE, RADIUS
from factories.clouds import random_cloud
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.sonicgauss_cases import cloud

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


def test_gaussians_that_show_no_object_are_refused() -> None:
    ball = _ball()
    in_one_place = replace(ball, centers=torch.zeros_like(ball.centers))
    for wrong, name in ((_ball(opacity=0.01), "opacities"), (_ball(99), "opacities"), (in_one_place, "centers")):
        with raises(SceneError, name=name):
            shape_of_cloud(wrong)


def test_gaussians_meters_away_are_left_out_and_a_long_thin_object_is_kept_whole() -> None:
    generator = torch.Generator().manual_seed(0)
    rod = torch.rand(3000, 3, generator=generator) * torch.tensor([0.4, 0.01, 0.01])
    far = 3 * torch.randn(90, 3, generator=generator)
    kept = without_far(random_cloud(torch.cat([rod, far])))
    assert torch.equal(kept.centers, rod)
    assert len(without_far(random_cloud(rod))) == 3000


SPHERE = trimesh.creation.icosphere(4, 0.1)
SURFACE = Surface(torch.from_numpy(SPHERE.vertices).float(), torch.from_numpy(SPHERE.faces))


def gaussians() -> tuple[FeatureField, torch.Tensor]:
    """Return points about a ball, each with its row as feature, and their distances from the middle."""
    generator = torch.Generator().manual_seed(0)
    ways = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=1)
    radius = torch.where(torch.arange(600) % 10 == 0, 0.08, 0.1 + 0.002 * torch.randn(600, generator=generator))
    return FeatureField(radius[:, None] * ways, torch.arange(600.0)[:, None], "rows"), radius


def test_points_move_onto_the_mesh_and_those_far_from_it_go() -> None:
    features, radius = gaussians()
    moved = moved_onto(features, SURFACE)
    size = 0.2 * 3**0.5
    kept = torch.nonzero((radius - 0.1).abs() <= OFF_MESH * size).flatten()
    assert torch.equal(moved.features[:, 0].long(), kept)
    assert 500 < len(kept) < 560
    # Triangles of this ball lie up to .2 % of the radius beneath it.
    assert float((moved.points.norm(dim=1) - 0.1).abs().max()) < 3e-4
    ways = torch.nn.functional.normalize(features.points[kept], dim=1)
    assert float((moved.points - 0.1 * ways).norm(dim=1).max()) < 1e-3


def test_points_of_another_frame_and_a_cloud_change_nothing() -> None:
    features, _ = gaussians()
    far = Surface(SURFACE.vertices + 1.0, SURFACE.faces)
    bare = Surface(SURFACE.vertices, SURFACE.faces[:0])
    assert moved_onto(features, far) is features
    assert moved_onto(features, bare) is features


def test_given_gaussians_are_read_and_an_object_that_nothing_shows_is_refused(tmp_path: Path) -> None:
    for name in ("shown", "hidden"):
        fill_plate(tmp_path / "set" / name, surface=False)
    given = cloud(200)
    write_splats(given, tmp_path / "set" / "shown" / "splats.ply")
    looks = ObjectInputs(CaptureCollection(tmp_path / "set"), tmp_path / "cache")
    assert torch.equal(looks.cloud("shown").centers, given.centers)
    assert torch.equal(looks.cloud("shown", views=12).centers, given.centers)
    with pytest.raises(SceneError):
        looks.cloud("hidden")
