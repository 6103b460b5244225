"""Features, outlines and clouds of an object's photographs or mesh."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.capture import CaptureSettings
from avmsf.capture.settings import METRES
from avmsf.cli import main
from avmsf.datasets import CaptureCollection
from avmsf.errors import CaptureError, SceneError
from avmsf.evaluation.objects import ObjectInputs
from avmsf.features.feature_field import FeatureField
from avmsf.features.lift import Lifted
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import write_splats
from avmsf.gaussians.start_points import StartPoints, starting_cloud
from avmsf.mesh import Surface
from avmsf.photographs.folder import write_frames
from avmsf.pipeline.config import PRESETS, LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.features import finish_features
from avmsf.pipeline.scene import SceneStages, shape_of_cloud, without_far
from avmsf.pipeline.shape import OFF_MESH, moved_onto
from avmsf.pipeline.stages import Kept, StageFolder
from avmsf.pipeline.visual_checks import expect_contacts_in_views, expect_mesh_in_views
from factories.ball_views import MIDDLE, RADIUS, ball_normals
from factories.clouds import cloud, random_cloud
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.small_scene import slab, slab_views


def lifted(features: torch.Tensor) -> Lifted:
    """Return features of points without a symmetry, which all views see."""
    points = torch.rand(len(features), 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1.0, 2.0, 4.0])
    once = torch.ones(len(features), dtype=torch.int64)
    return Lifted(FeatureField(points, features, "made"), once, once, once, 1.0)


SAID = 40.0 + 3.0 * torch.randn(300, 16, generator=torch.Generator().manual_seed(0))


def test_without_components_features_are_what_the_encoder_said_and_their_scale_is_reported() -> None:
    for config in (PRESETS["paper"].scene.lift, LiftConfig(components=0)):
        features, report = finish_features(lifted(SAID), config)
        assert torch.equal(features.features[:, -16:], SAID)
    read, report = finish_features(lifted(SAID), PRESETS["paper"].scene.lift)
    assert report["length"] == pytest.approx(float(read.features.norm(dim=1).square().mean().sqrt()))
    # Sixteen numbers of mean 40 and standard deviation 3.
    assert report["length"] == pytest.approx(4 * 40, rel=0.01)
    assert report["variation"] == pytest.approx(4 * 3, rel=0.05)


def test_components_are_centered_and_have_the_length_that_is_asked_for() -> None:
    features, report = finish_features(lifted(SAID), LiftConfig(components=4, positions=False))
    assert features.features.shape == (300, 4)
    assert (report["length"], report["variation"]) == pytest.approx((1.0, 1.0))
    beside, _ = finish_features(lifted(SAID), LiftConfig(components=4))
    assert float(beside.features[:, 3:].norm(dim=1).square().mean().sqrt()) == pytest.approx(0.3)


def test_standardized_features_have_mean_zero_and_length_one() -> None:
    config = replace(PRESETS["paper"].scene.lift, standardize=True)
    features, report = finish_features(lifted(SAID), config)
    assert (report["length"], report["variation"]) == pytest.approx((1.0, 1.0))
    # They differ from what was said in nothing else.
    torch.testing.assert_close(features.features * (SAID - SAID.mean(0)).norm() / 300**0.5, SAID - SAID.mean(0))


def test_components_are_not_standardized_as_well() -> None:
    with raises(SceneError, name="standardize", value=32):
        LiftConfig(standardize=True)


def test_features_that_say_nothing_are_refused() -> None:
    for components in (0, 4):
        with raises(SceneError, name="made", value=300):
            finish_features(lifted(torch.ones(300, 16)), LiftConfig(components=components))


VIEWS = slab_views(192)


def scaled(factor: float) -> Surface:
    return Surface(factor * slab().vertices, slab().faces)


def test_a_mesh_of_another_size_or_place_or_a_tenth_of_wrong_masks_is_no_other_unit() -> None:
    settings = CaptureSettings()
    wrong = [
        replace(view, mask=torch.full_like(view.mask, 255)) if row % 10 == 0 else view for row, view in enumerate(VIEWS)
    ]
    moved = Surface(slab().vertices + 0.02, slab().faces)
    for surface, views in ((slab(), wrong), (scaled(1.5), VIEWS), (scaled(0.5), VIEWS), (moved, VIEWS)):
        expect_mesh_in_views(surface, views, settings)
    expect_mesh_in_views(scaled(100.0), [replace(view, mask=None) for view in VIEWS], settings)


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_cameras_or_contacts_in_another_unit_are_refused_with_it(unit: str) -> None:
    """A mesh and contacts in meters, cameras in another unit that the settings do not name; and the other way round."""
    settings, factor, contacts = CaptureSettings(), METRES[unit], slab().vertices
    for each, key in ((factor, "views_unit"), (1 / factor, "unit")):
        with raises(CaptureError, name="surface_unit", value={key: unit}):
            expect_mesh_in_views(scaled(each), VIEWS, settings)
    expect_contacts_in_views(contacts, VIEWS, settings)
    expect_contacts_in_views(contacts / factor, [replace(view, mask=None) for view in VIEWS], settings)
    with raises(CaptureError, name="unit", value={"unit": unit}):
        expect_contacts_in_views(contacts / factor, VIEWS, settings)


def test_reconstruct_refuses_them_before_it_fits_gaussians(tmp_path: Path) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    slab().write(folder / "surface.ply")
    write_frames(slab_views(), folder)
    with open(folder / "capture.toml", "a") as file:
        file.write('views_unit = "cm"\n')
    assert main(["fit", str(folder), "--gain-model", "visual", "--set", "lift.encoder=descriptors"]) == 2
    assert not (folder / ".avmsf" / "cloud.ply").exists()


CELLS = 48


def _ball(count: int = 3000, *, opacity: float = 0.95) -> GaussianCloud:
    normals = ball_normals(count)
    return _discs(torch.tensor(MIDDLE) + RADIUS * normals, normals, opacity=opacity)


def _discs(points: torch.Tensor, normals: torch.Tensor, *, opacity: float = 0.95) -> GaussianCloud:
    start = StartPoints(points, torch.full_like(points, 0.5), normals)
    return starting_cloud(start, degree=0, scale=1.0, opacity=opacity, flatness=0.1)


@pytest.mark.slow
def test_a_ball_of_gaussians_is_a_closed_ball_that_faint_ones_around_it_do_not_change() -> None:
    ball = _ball()
    haze = replace(ball, centers=torch.tensor(MIDDLE) + 2 * (ball.centers - torch.tensor(MIDDLE)))
    haze = replace(haze, logit_opacities=torch.full((len(ball),), -4.0))
    surface, other = (shape_of_cloud(each, cells=CELLS).as_seen() for each in (ball, ball.join(haze)))
    assert torch.equal(surface.vertices, other.vertices)
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
ROUND = Surface(torch.from_numpy(SPHERE.vertices).float(), torch.from_numpy(SPHERE.faces))


def gaussians() -> tuple[FeatureField, torch.Tensor]:
    """Return points about a ball, each with its row as feature, and their distances from the middle."""
    generator = torch.Generator().manual_seed(0)
    ways = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=1)
    radius = torch.where(torch.arange(600) % 10 == 0, 0.08, 0.1 + 0.002 * torch.randn(600, generator=generator))
    return FeatureField(radius[:, None] * ways, torch.arange(600.0)[:, None], "rows"), radius


def test_points_move_onto_the_mesh_and_those_far_from_it_go() -> None:
    features, radius = gaussians()
    moved = moved_onto(features, ROUND)
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
    far = Surface(ROUND.vertices + 1.0, ROUND.faces)
    bare = Surface(ROUND.vertices, ROUND.faces[:0])
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


def test_gaussians_need_no_cameras_of_pictures_beside_them(tmp_path: Path) -> None:
    write_splats(random_cloud(200), tmp_path / "splats.ply")
    (tmp_path / "walk.mp4").touch()
    made = SceneStages(tmp_path, StageFolder(tmp_path / "cache"), SceneConfig(), settings=CaptureSettings())
    assert made.source is None
    assert "motion" not in made.stages


def test_new_weights_in_an_encoders_folder_make_features_anew(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    write_splats(cloud(200), tmp_path / "splats.ply")
    config = transformers.Dinov2Config(hidden_size=8, num_hidden_layers=1, num_attention_heads=1)
    lift = LiftConfig(encoder=str(tmp_path / "model"), components=0, symmetry=False, longest=28)
    given = SceneConfig(views=ViewsConfig(rendered=32), lift=lift)

    def features() -> Kept:
        stages = StageFolder(tmp_path / "cache")
        return SceneStages(tmp_path, stages, given, settings=CaptureSettings()).features

    fresh = []
    for seed in (0, 1, 1):
        torch.manual_seed(seed)
        transformers.Dinov2Model(config).save_pretrained(tmp_path / "model")
        fresh.append(features().fresh)
    assert fresh == [True, True, False]
