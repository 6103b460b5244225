from dataclasses import replace

import pytest
import torch

from avmsf.errors import CaptureWarning, SceneError
from avmsf.gaussians.initialize import StartPoints
from avmsf.gaussians.start_points import visual_hull
from factories.ball_views import MIDDLE, RADIUS, ball_cameras, ball_view, ball_views
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
