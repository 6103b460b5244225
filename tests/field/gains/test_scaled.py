"""Gains times a factor a mode, and positions on the body that gains have."""

import pytest
import torch

from avmsf._utils.text import RecordError
from avmsf.field.gains.model import off_surface, off_surface_gains, points_on_object
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.residual_noise import Residual
from factories.believing_field import LENGTH, bar, bar_points
from factories.made_fields import BANK, FIELDS, blows, places, positional
from factories.raising import raises

FACTORS = torch.tensor([2.0, -0.5, 1.5, 0.0, 3.0], dtype=torch.float64)
PLACES = places(7, seed=8)
BLOWS = blows(PLACES, seed=9)


@pytest.mark.parametrize("name", ["attention with dampings", "positional", "elastic"])
def test_gains_and_deviations_are_the_inner_fields_times_the_factors(name):
    inner = FIELDS[name]()
    scaled = ScaledGains(inner, FACTORS)
    before, after = (each.predict(PLACES, BLOWS) for each in (inner, scaled))
    # A float32 number times a factor is rounded once.
    torch.testing.assert_close(after.parts, before.parts * FACTORS[:, None], rtol=1e-7, atol=0)
    assert before.damping is None or torch.equal(before.damping, after.damping)
    assert (before.damping is None) == (after.damping is None)
    deviations = [each.posterior(PLACES, BLOWS).std for each in (inner, scaled)]
    assert deviations[0] is None or torch.allclose(
        deviations[1], deviations[0] * FACTORS.abs().float()[:, None], rtol=1e-6
    )
    assert torch.equal(scaled.points, inner.points)


@pytest.mark.parametrize("name", ["attention", "positional", "elastic"])
def test_on_a_larger_object_places_are_where_they_would_be_on_the_small_one(name):
    inner = FIELDS[name]()
    large = ScaledGains(inner, torch.ones(5, dtype=torch.float64), 4.0)
    # Four is a power of two: lengths are not rounded.
    assert torch.equal(large.points, 4 * inner.points)
    assert torch.equal(large.predict(4 * PLACES, BLOWS).mean, inner.predict(PLACES, BLOWS).mean)
    deviations = large.posterior(4 * PLACES, BLOWS).std, inner.posterior(PLACES, BLOWS).std
    assert deviations == (None, None) or torch.equal(*deviations)
    assert not torch.equal(large.predict(PLACES, BLOWS).mean, inner.predict(PLACES, BLOWS).mean)


def test_of_scaled_gains_the_factors_multiply_and_nothing_nests(tmp_path):
    inner = FIELDS["positional"]()
    twice = ScaledGains(ScaledGains(inner, FACTORS, 0.5), 3 * FACTORS, 3.0)
    assert twice.field is inner
    assert torch.equal(twice.scale, 3 * FACTORS**2)
    assert twice.length == 1.5
    save(SoundField(BANK, twice, torch.zeros(5).double(), Residual(torch.zeros(9)), 8e3, 9, Origin()), tmp_path / "one")
    loaded = load(tmp_path / "one").gain_field
    assert torch.equal(loaded.predict(PLACES).mean, twice.predict(PLACES).mean)
    assert loaded.length == 1.5
    assert type(loaded.field) is type(inner)


def test_lengths_and_inner_fields_that_cannot_be_are_refused():
    inner = FIELDS["positional"]()
    for length in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError):
            ScaledGains(inner, FACTORS, length)
    record = ScaledGains(inner, FACTORS).record()
    with raises(RecordError, name="fitted_kind", value="scaled"):
        ScaledGains.skeleton(record | {"fitted_kind": "scaled"})


HEIGHT = 0.05
"""Of a false floor above the bar's sheet, meters: an eighth of the length, more than the tolerance."""


def closed() -> BodyGains:
    """Return gains on the bar's sheet whose points lie on the sheet and on a false floor above it."""
    points = bar_points()
    return BodyGains(torch.cat([points, points + torch.tensor([0.0, 0.0, HEIGHT])]).float(), bar())


def test_a_place_on_a_false_floor_is_off_the_body_by_its_height() -> None:
    above = torch.tensor([[0.2, 0.05, 0.0], [0.2, 0.05, HEIGHT]])
    ((row, distance),) = off_surface(above, closed())
    assert row == 1
    assert abs(distance - HEIGHT) < 1e-6


def test_only_a_body_has_the_gains_of_its_nearest_point() -> None:
    assert off_surface_gains(closed()) != off_surface_gains(positional())
    assert off_surface_gains(ScaledGains(closed(), torch.ones(6, dtype=torch.float64), 2.0)) == off_surface_gains(
        closed()
    )


def test_points_of_the_false_floor_are_no_contacts() -> None:
    assert torch.equal(points_on_object(closed()), bar_points().float())
    # Gains without a body are known at all of their points.
    assert torch.equal(points_on_object(positional()), positional().points)


def test_an_edited_body_is_scaled() -> None:
    large = ScaledGains(closed(), torch.ones(6, dtype=torch.float64), 2.0)
    surface = large.surface
    assert float(surface.vertices[:, 0].max()) == 2.0 * float(torch.tensor(LENGTH))
    assert len(points_on_object(large)) == len(bar_points())
    ((_, distance),) = off_surface(torch.tensor([[0.4, 0.1, 2.0 * HEIGHT]]), large)
    assert abs(distance - 2.0 * HEIGHT) < 1e-6
    assert positional().surface is None
