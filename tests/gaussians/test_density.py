"""Where Gaussians start, and which are doubled, split and left out."""

from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from avmsf.errors import CaptureWarning, SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.density import Density, blended_weight, keep_object
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer
from avmsf.gaussians.start_points import StartPoints, starting_cloud, visual_hull
from factories.ball_views import MIDDLE, RADIUS, ball_cameras, ball_color, ball_normals, ball_view, ball_views
from factories.clouds import random_cloud
from factories.raising import raises, warns


def _radii(hull: StartPoints) -> torch.Tensor:
    return (hull.points.double() - torch.tensor(MIDDLE, dtype=torch.float64)).norm(dim=1)


def _expect_ball(hull: StartPoints, *, pixel: float = 0.3 / 192) -> None:
    radii = _radii(hull)
    # Of two neighbors one lies a voxel's edge from the other.
    spacing = float(torch.cdist(hull.points[:500], hull.points[:500]).fill_diagonal_(1.0).min())
    # Nothing of the ball is carved away by more than a voxel's diagonal and a pixel at its distance.
    assert float(radii.min()) > RADIUS - 1.8 * spacing - pixel
    # Between 40 cones that touch a ball, corners stand out: of cones 30 degrees apart by 1 / cos 15 degrees, 3.5 %.
    assert float(radii.quantile(0.95)) < 1.035 * RADIUS + 1.8 * spacing + pixel


def test_the_hull_of_a_ball_is_a_ball_with_normals_outwards() -> None:
    hull = visual_hull(ball_views(40, size=96), points=3000)
    _expect_ball(hull)
    assert len(hull.points) == pytest.approx(3000, rel=0.15)
    outwards = (hull.points - torch.tensor(MIDDLE)) / _radii(hull)[:, None].float()
    assert float((hull.normals * outwards).sum(1).quantile(0.05)) > 0.8
    torch.testing.assert_close(hull.normals.norm(dim=1), torch.ones(len(hull.points)), rtol=0, atol=1e-5)


def test_what_lies_outside_an_image_is_left_to_other_views() -> None:
    views = ball_views(40, size=96)
    # A quarter of the cameras look past the ball, so that a part of it is cut off by the image's edge.
    for place, camera in list(enumerate(ball_cameras(40, size=96, aim=(0.03, 0.02, 0.04))))[::4]:
        views[place] = ball_view(camera, name=f"aside {place}")
    edges = [view.mask for view in views[::4] if view.mask is not None]
    assert any(bool((torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) > 0).any()) for mask in edges)
    _expect_ball(visual_hull(views, points=3000))


def test_a_few_wrong_masks_among_many_carve_nothing_away() -> None:
    views = ball_views(42, size=96)
    first, second = views[7].mask, views[20].mask
    views[7] = replace(views[7], mask=torch.where(torch.arange(96)[:, None] < 48, first, 0))
    views[20] = replace(views[20], mask=second.roll(25, dims=1))
    _expect_ball(visual_hull(views, points=3000))
    views[30] = replace(views[30], mask=torch.zeros(96, 96, dtype=torch.uint8))
    with warns(CaptureWarning, name="masks", value=["30.png"]):
        hull = visual_hull(views, points=3000)
    _expect_ball(hull)


def test_views_that_leave_nothing_are_refused() -> None:
    views, empty, spot = ball_views(8), torch.zeros(64, 64, dtype=torch.uint8), torch.zeros(64, 64, dtype=torch.uint8)
    # Each view has the object in a corner of its image that no other view shows.
    spot[2:5, 2:5] = 255
    for wrong, name, value in (
        ([replace(view, mask=empty) for view in views], "masks", [view.name for view in views]),
        (ball_views(5, masked=False), "views", 0),
        (ball_views(2), "views", 2),
        ([replace(view, mask=spot) for view in views], "masks", 8),
    ):
        with raises(SceneError, name=name, value=value):
            visual_hull(wrong, points=500)


CONFIG = SplatConfig(growth=1.0, large=0.01, least_opacity=0.1, gaussians=10_000)


def _cloud(scales: list[float], opacities: list[float]) -> GaussianCloud:
    log_scales = torch.tensor(scales).log()[:, None].repeat(1, 3)
    return replace(
        random_cloud(len(scales), degree=1), log_scales=log_scales, logit_opacities=torch.tensor(opacities).logit()
    )


def _densified(cloud: GaussianCloud, gradient: list[float], config: SplatConfig) -> tuple[torch.Tensor, GaussianCloud]:
    # Seen twice each: the mean counts.
    density = Density(2 * torch.tensor(gradient), torch.full((len(cloud),), 2.0))
    return density.densify(cloud, config, 1.0, generator=torch.Generator().manual_seed(3))


def test_small_ones_are_copied_large_ones_split_and_faint_ones_go() -> None:
    cloud = _cloud([0.005, 0.005, 0.05, 0.05, 0.005, 0.9], [0.5, 0.5, 0.5, 0.5, 0.05, 0.5])
    rows, fresh = _densified(cloud, [2.0, 0.5, 3.0, 0.5, 9.0, 9.0], CONFIG)
    # 0 is copied and stays, 2 gives way to its halves, 4 is faint and 5 as large as the object: neither is doubled.
    assert rows.tolist() == [0, 1, 3]
    assert len(fresh) == 3
    for name in ("centers", "rotations", "log_scales", "logit_opacities", "harmonics"):
        assert torch.equal(getattr(fresh, name)[0], getattr(cloud, name)[0])
    torch.testing.assert_close(fresh.log_scales[1:].exp(), torch.full((2, 3), 0.05 / 1.6))


def test_halves_are_drawn_from_the_gaussian_that_they_replace() -> None:
    count = 4000
    scales = torch.tensor([0.2, 0.05, 0.02])
    turned = torch.tensor([0.9, 0.1, -0.3, 0.2])
    cloud = _cloud([0.2], [0.5])
    cloud = replace(cloud, rotations=turned[None], log_scales=scales.log()[None]).take(torch.zeros(count).long())
    _, fresh = _densified(cloud, [2.0] * count, CONFIG)
    offsets = (fresh.centers - cloud.centers[0]).double()
    rotation = torch.from_numpy(Rotation.from_quat(turned.tolist(), scalar_first=True).as_matrix())
    expected = rotation @ torch.diag(scales.double() ** 2) @ rotation.T
    # A covariance of 8000 draws is within sqrt(2 / 8000) = 1.6 %; four of these of the largest.
    torch.testing.assert_close(torch.cov(offsets.T), expected, rtol=0, atol=0.064 * 0.2**2)


def test_the_strongest_come_first_when_room_is_short() -> None:
    cloud = _cloud([0.005] * 5, [0.5] * 5)
    rows, fresh = _densified(cloud, [2.0, 5.0, 3.0, 4.0, 0.1], replace(CONFIG, gaussians=100))
    assert len(fresh) == 4
    _, fresh = _densified(
        cloud.take(torch.arange(100) % 5), [2.0, 5.0, 3.0, 4.0, 0.1] * 20, replace(CONFIG, gaussians=103)
    )
    assert torch.equal(fresh.centers, cloud.centers[[1, 1, 1]])
    assert rows.tolist() == [0, 1, 2, 3, 4]


COUNT = 800


def _ball(radius: float = RADIUS, *, opacity: float = 0.9) -> GaussianCloud:
    normals = ball_normals(COUNT)
    start = StartPoints(torch.tensor(MIDDLE) + radius * normals, ball_color(normals))
    return starting_cloud(start, degree=0, scale=1.0, opacity=opacity)


def _moved(cloud: GaussianCloud, count: int, offset: tuple[float, float, float]) -> GaussianCloud:
    some = cloud.take(torch.arange(count))
    return replace(some, centers=some.centers + torch.tensor(offset))


def test_what_is_not_the_object_goes_and_all_of_the_object_stays() -> None:
    ball, views = _ball(opacity=0.5), ball_views(24)
    # In front of some cameras, outside of all masks; faint ones on the ball; a huge one.
    outside = _moved(ball, 30, (0.12, 0.0, 0.0))
    faint = replace(_ball(), logit_opacities=torch.full((COUNT,), -4.0))
    huge = replace(ball.take(torch.tensor([0])), log_scales=torch.full((1, 3), RADIUS).log())
    kept = keep_object(ball.join(outside).join(faint).join(huge), views)
    assert torch.equal(kept.centers, ball.centers)


def test_wrong_masks_of_a_few_views_take_nothing_away() -> None:
    ball, views = _ball(opacity=0.5), ball_views(24)
    for row in (3, 11):
        views[row] = replace(views[row], mask=views[row].mask.roll(30, dims=0))
    views[5] = replace(views[5], mask=torch.zeros(64, 64, dtype=torch.uint8))
    views[6] = replace(views[6], mask=None)
    assert len(keep_object(ball, views)) == COUNT


def test_without_masks_what_floats_alone_goes() -> None:
    ball = _ball(opacity=0.5)
    alone = _moved(ball, 3, (0.3, 0.0, 0.0))
    kept = keep_object(ball.join(alone), ball_views(6, masked=False))
    assert torch.equal(kept.centers, ball.centers)


def test_the_hidden_inside_goes_with_a_rasterizer() -> None:
    shell, core = _ball(opacity=0.95), _ball(0.4 * RADIUS)
    views = ball_views(24)
    assert len(keep_object(shell.join(core), views)) == 2 * COUNT
    kept = keep_object(shell.join(core), views, rasterizer=NumbaRasterizer())
    radii = (kept.centers - torch.tensor(MIDDLE)).norm(dim=1)
    assert float((radii < 0.5 * RADIUS).float().mean()) < 0.02
    assert int((radii > 0.9 * RADIUS).sum()) > 0.97 * COUNT


def test_weights_of_a_view_sum_to_its_coverage() -> None:
    ball, view = _ball(opacity=0.7), ball_views(1)[0]
    weights = blended_weight(ball, [view], rasterizer=NumbaRasterizer())
    alpha = NumbaRasterizer()(ball, view.camera, background=torch.zeros(3)).alpha
    # Sums of 800 shares and of 4096 pixels in float32.
    assert float(weights.sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)


def test_a_cloud_that_is_not_on_the_object_is_refused() -> None:
    away = replace(_ball(), centers=_ball().centers + 1.0)
    with raises(SceneError, name="gaussians", value=0):
        keep_object(away, ball_views(6))
