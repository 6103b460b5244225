from dataclasses import replace

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.prune import blended_weight, keep_object
from avmsf.gaussians.rasterizer.rasterizers import NumbaRasterizer
from factories.ball_views import MIDDLE, RADIUS, ball_color, ball_normals, ball_views
from factories.raising import raises

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
