"""The gain model on a plate: its symmetries, impacts too near to tell apart, and what mode shapes are worth."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites, Smooth, ThinPlate, Unstructured
from avmsf.field.gains.mixture_gains import MixtureGains
from factories.made_fields import BANK, DIAGONAL, blows, places, plate, struck

PLACES = places(60, seed=8)
BLOWS = blows(PLACES, seed=9)


def fitted(sites: Sites, values: Tensor, body: ElasticModes | None = None, *, size: float = DIAGONAL) -> MixtureGains:
    families = [each(sites, size) for each in (Unstructured, Smooth, ThinPlate)]
    if body is not None:
        families.append(Elastic(sites, size, body))
    variance = torch.full((len(BANK),), 1e-4, dtype=torch.float64)
    measured = MeasuredGains(values, variance, BANK.frequency, BANK.damping)
    return fit_mixture(families, measured, sites.points.float(), directional=True)


def mean(model: MixtureGains, points: Tensor, directions: Tensor | None = None) -> Tensor:
    return model.predict(points, directions).mean.to(torch.complex128)


def expect_close(found: Tensor, expected: Tensor, *, within: float = 1e-6) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=within * float(expected.abs().max()))


@pytest.mark.parametrize("body", [None, plate()], ids=["positional", "elastic"])
def test_an_object_that_is_moved_turned_and_enlarged_has_the_same_gains(body):
    sites, values = struck(12)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))).Q
    turn = turn * torch.linalg.det(turn)

    def moved(points: Tensor) -> Tensor:
        return 4.0 * points @ turn.T + torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)

    there = None if body is None else replace(body, nodes=moved(body.nodes), shapes=body.shapes @ turn.T)
    here = fitted(sites, values, body)
    elsewhere = fitted(Sites(moved(sites.points), sites.directions @ turn.T), values, there, size=4.0 * DIAGONAL)
    # Mode shapes are held in float32.
    found, expected = mean(elsewhere, moved(PLACES), BLOWS @ turn.T), mean(here, PLACES, BLOWS)
    expect_close(found, expected, within=1e-4)
    deviations = elsewhere.posterior(moved(PLACES), BLOWS @ turn.T).std, here.posterior(PLACES, BLOWS).std
    expect_close(*deviations, within=1e-3)


@pytest.mark.parametrize("body", [None, plate()], ids=["positional", "elastic"])
def test_impacts_from_the_other_side_with_opposite_gains_say_the_same(body):
    sites, values = struck(12)
    side = torch.where(torch.arange(12) % 3 == 0, -1.0, 1.0).double()[:, None]
    opposite = fitted(Sites(sites.points, side * sites.directions), side * values, body)
    expect_close(mean(opposite, PLACES, BLOWS), mean(fitted(sites, values, body), PLACES, BLOWS))


def test_mode_shapes_predict_what_positions_cannot_and_know_how_well():
    sites, values = struck(9, noise=0.0)
    scale = torch.linspace(2.0, 0.5, len(BANK), dtype=torch.float64)
    shapes = plate().gains(PLACES, BLOWS)[:, : len(BANK)]
    truth = torch.complex(shapes, 0.3 * shapes.roll(1, dims=1)) * scale
    errors = [mean(fitted(sites, values, body), PLACES, BLOWS) - truth for body in (plate(), None)]
    own, other = (float((each.abs().square().mean(0) / truth.abs().square().mean(0)).mean()) ** 0.5 for each in errors)
    assert own < 0.4 * other
    deviation = fitted(sites, values, plate()).posterior(PLACES, BLOWS).std.double()
    within = torch.view_as_real(errors[0]).abs() < 1.645 * deviation
    # Of draws from the model .9; shapes that are exact leave less unknown than the hypotheses allow for.
    assert float(within.double().mean()) > 0.85


def test_two_impacts_near_each_other_that_differ_do_not_make_gains_run_away():
    sites, values = struck(12)
    near = sites.points[:1] + torch.tensor([[1e-4, 0.0, 0.0]], dtype=torch.float64)
    size = float(values.abs().max())
    both = Sites(torch.cat([sites.points, near]), torch.cat([sites.directions, sites.directions[:1]]))
    model = fitted(both, torch.cat([values, values[:1] + size]))
    assert model.place_count == 12
    # A slope of their difference over a tenth of a millimeter would reach a thousand times as far.
    assert float(mean(model, PLACES).abs().max()) < 3.0 * size


def test_impacts_in_one_place_have_their_mean_there():
    sites, values = struck(1)
    again = sites.take(torch.zeros(4, dtype=torch.int64))
    noise = 0.02 * torch.tensor([1.0, -1.0, 2.0, -2.0], dtype=torch.float64)[:, None]
    model = fitted(again, values * (1.0 + noise))
    assert model.place_count == 1
    expect_close(mean(model, sites.points, sites.directions), values, within=0.05)
    assert bool(mean(model, PLACES).isfinite().all())
    assert bool(model.posterior(PLACES).std.isfinite().all())
