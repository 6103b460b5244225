from dataclasses import replace

import numpy as np
import pytest
import torch

from avmsf.photographs.hull import Grid
from avmsf.reconstruction.visual_hull import Outline, hull_distance
from factories.looked_at import ball, views_of

RADIUS = 0.05
GRID = Grid(np.full(3, -0.06), 0.004, (31, 31, 31))


def test_an_outline_lies_where_half_of_a_pixel_is_covered() -> None:
    (view, *_) = views_of(ball(RADIUS))
    mask = torch.zeros_like(view.mask)
    mask[:, 40:80] = 255
    mask[:, 80] = 64
    inside = Outline.of(replace(view, mask=mask)).inside
    # Between the middles of pixels 79, all covered, and 80, a quarter covered: two thirds of the way.
    assert inside[64, 78] == pytest.approx(1.67, abs=0.2)
    assert inside[64, 85] == pytest.approx(-5.33, abs=0.2)


def test_the_hull_of_a_ball_is_the_ball_within_half_a_pixel() -> None:
    outlines = [Outline.of(view) for view in views_of(ball(RADIUS), azimuths=24)]
    found = hull_distance(outlines, GRID, rank=0)
    truth = RADIUS - np.linalg.norm(GRID.places(np.argwhere(np.ones(GRID.shape, bool))), axis=1).reshape(GRID.shape)
    near = np.abs(truth) < 0.004
    # A pixel is 1 mm wide there.
    assert float(np.abs(found - truth)[near].mean()) < 0.5e-3


def test_a_higher_rank_forgives_as_many_wrong_masks() -> None:
    views = list(views_of(ball(RADIUS)))
    views[0] = replace(views[0], mask=torch.zeros_like(views[0].mask))
    outlines = [Outline.of(view) for view in views]
    assert not (hull_distance(outlines, GRID, rank=0) > 0).any()
    assert (hull_distance(outlines, GRID, rank=1) > 0).any()
