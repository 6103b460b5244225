"""Gains times a factor a mode: what the contract of all gain fields does not say."""

import pytest
import torch

from avmsf._utils.text import RecordError
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.residual_noise import Residual
from factories.made_fields import BANK, FIELDS, blows, places
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
