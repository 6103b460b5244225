"""Distances on a grid: from outlines, from a surface, and from the membrane that fair hulls are."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from avmsf.mesh.level_set import enclose
from avmsf.photographs.visual_hull import Grid
from avmsf.reconstruction.distance import distance_from
from avmsf.reconstruction.fairing import fair_hull
from avmsf.reconstruction.hull_distance import Outline, hull_distance
from factories.looked_at import ball, mesh_of, views_of

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
    truth = RADIUS - np.linalg.norm(GRID.centers(np.argwhere(np.ones(GRID.shape, bool))), axis=1).reshape(GRID.shape)
    near = np.abs(truth) < 0.004
    # A pixel is 1 mm wide there.
    assert float(np.abs(found - truth)[near].mean()) < 0.5e-3


def test_a_higher_rank_forgives_as_many_wrong_masks() -> None:
    views = list(views_of(ball(RADIUS)))
    views[0] = replace(views[0], mask=torch.zeros_like(views[0].mask))
    outlines = [Outline.of(view) for view in views]
    assert not (hull_distance(outlines, GRID, rank=0) > 0).any()
    assert (hull_distance(outlines, GRID, rank=1) > 0).any()


def _ball() -> np.ndarray:
    places = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), axis=-1)
    return (8.3 - np.linalg.norm(places - 12.2, axis=-1)).astype(np.float32)


def test_distances_from_a_ball_are_exact_within_a_tenth_of_a_cell() -> None:
    values = _ball()
    found = distance_from(np.clip(values, -2.5, 2.5))
    off = np.abs(found - np.abs(values))
    assert off.mean() < 0.03
    assert np.quantile(off, 0.99) < 0.1


def test_a_part_that_is_left_out_is_no_surface() -> None:
    values = _ball()
    upper = np.zeros(values.shape, dtype=bool)
    upper[12:] = True
    found = distance_from(values, upper)
    # The nearest place of the lower half, from the top of the ball, is on its rim.
    assert found[20, 12, 12] == pytest.approx(np.hypot(8.3, 8.0), abs=0.8)
    assert np.isinf(distance_from(values, np.ones(values.shape, dtype=bool))).all()


def _hull(mesh: trimesh.Trimesh, *, taut: bool) -> trimesh.Trimesh:
    outlines = [Outline.of(view) for view in views_of(mesh, azimuths=24)]
    grid = Grid.around(mesh.bounds[0] - 0.03, mesh.bounds[1] + 0.03, cells=96, finest=1.0, margin=2)
    hull = hull_distance(outlines, grid, rank=0)
    values = fair_hull(hull, outlines, grid, float(np.linalg.norm(mesh.extents)))[0] if taut else hull
    return mesh_of(enclose(values, 0.0, lowest=grid.lowest, spacing=grid.spacing))


@pytest.mark.slow
def test_the_pyramid_above_a_flat_top_is_removed() -> None:
    block = trimesh.creation.cylinder(radius=0.05, height=0.04, sections=96)
    above = _hull(block, taut=False).bounds[1, 2] - 0.02
    assert above > 0.003
    assert _hull(block, taut=True).bounds[1, 2] - 0.02 < 0.35 * above


@pytest.mark.slow
def test_a_ball_stays_as_large_as_its_hull() -> None:
    before, after = (_hull(ball(0.05), taut=taut).volume for taut in (False, True))
    assert after == pytest.approx(before, rel=0.01)
