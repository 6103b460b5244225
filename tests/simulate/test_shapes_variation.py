"""Walls of uneven thickness: as uneven as asked, smooth, and never inside out."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from avmsf.errors import SimulationError
from avmsf.fem.solid import Solid
from avmsf.simulate.shapes import make_shape
from avmsf.simulate.thickness_variation import vary_thickness
from factories.raising import raises


def chance(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def across(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a platter's points below and above each other, its rim left out."""
    points = solid.points.numpy()
    inner = (np.abs(points[:, :2]) < 0.99 * points[:, :2].max(axis=0)).all(axis=1)
    below, above = np.flatnonzero(inner & (points[:, 2] < 0)), np.flatnonzero(inner & (points[:, 2] > 0))
    return below, above[cKDTree(points[above, :2]).query(points[below, :2])[1]]


@pytest.mark.parametrize("part", [0.02, 0.1, 0.4])
def test_a_plate_varies_by_the_part_asked_for(part: float) -> None:
    solid = make_shape("platter").solid
    below, above = across(solid)
    varied = vary_thickness(solid, part, generator=chance())
    thickness = (varied.points[above] - varied.points[below])[:, 2].numpy()
    before = float((solid.points[above] - solid.points[below])[0, 2])
    # The rim, left out here, is a tenth of the points.
    assert thickness.std() / thickness.mean() == pytest.approx(part, rel=0.1)
    assert thickness.mean() == pytest.approx(before, rel=0.25 * part)
    assert varied.volume == pytest.approx(solid.volume, rel=0.25 * part)
    # Smooth: neighbors differ by little.
    _, near = cKDTree(solid.points[below].numpy()).query(solid.points[below].numpy(), k=2)
    assert np.abs(thickness - thickness[near[:, 1]]).max() < 0.5 * part * before


def test_a_tube_keeps_its_middle() -> None:
    solid = make_shape("tube").solid
    points = solid.points.numpy()
    radius = np.hypot(*points[:, :2].T)
    inner = np.flatnonzero(radius < np.median(radius))
    outer = np.flatnonzero(radius > np.median(radius))
    directions = points / np.concatenate([radius[:, None], radius[:, None], np.ones((len(points), 1))], axis=1)
    partner = outer[cKDTree(directions[outer]).query(directions[inner])[1]]
    varied = vary_thickness(solid, 0.2, generator=chance(3)).points.numpy()
    away = np.hypot(*varied[:, :2].T)
    thickness, middle = away[partner] - away[inner], 0.5 * (away[partner] + away[inner])
    assert thickness.std() / thickness.mean() == pytest.approx(0.2, rel=0.1)
    assert np.abs(middle / np.median(middle) - 1.0).max() < 0.02


@pytest.mark.parametrize("kind", ["bowl", "mug", "spoon", "blob", "bracket"])
@pytest.mark.parametrize("part", [0.03, 0.5])
def test_no_tetrahedron_is_turned_inside_out(kind: str, part: float) -> None:
    solid = make_shape(kind, seed=2).solid
    varied = vary_thickness(solid, part, generator=chance(1))
    assert torch.equal(varied.cells, solid.cells)
    varied.expect_volume()
    # No tetrahedron may be moved further than its wall grows: a point by no more than half the thickest of all walls.
    assert float((varied.points - solid.points).norm(dim=1).max()) < 1.5 * part * solid.size


def test_chance_decides_and_zero_changes_nothing() -> None:
    solid = make_shape("spoon").solid
    assert vary_thickness(solid, 0.0, generator=chance()) is solid
    one, same, other = (vary_thickness(solid, 0.05, generator=chance(seed)).points for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert float((one - other).norm(dim=1).max()) > 1e-5


@pytest.mark.parametrize("part", [-0.1, 0.6, float("nan")])
def test_impossible_variations(part: float) -> None:
    with raises(SimulationError, name="part", value=pytest.approx(part, nan_ok=True)):
        vary_thickness(make_shape("spoon").solid, part, generator=chance())
