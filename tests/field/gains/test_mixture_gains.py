"""The gain model: predictions against dense computations, invariances, and what mode shapes are worth."""

from dataclasses import replace

import pytest
import torch

from avmsf.field.gains import mixture_gains as module
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import series_of
from factories.made_fields import draw, families, impacts, measured, model
from oracles import gain_model as oracle

ASKED = impacts(9, seed=5)
MODES = 5


def gains_at(given: MixtureGains, sites: Sites = ASKED) -> torch.Tensor:
    found = given.predict(sites.points, sites.directions)
    return found.mean.to(torch.complex128)


def deviation_at(given: MixtureGains, sites: Sites = ASKED) -> torch.Tensor:
    return given.posterior(sites.points, sites.directions).std.double()


def joint_kernels(given: MixtureGains) -> torch.Tensor:
    """Return all kept kernels among the training impacts and the asked ones."""
    both = Sites.joined([given.training, ASKED])
    return torch.cat([family.between(both, both) for family in given.families])


def dense(
    given: MixtureGains, kernel: torch.Tensor, share: int, series: int
) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Return one hypothesis's mean and covariance of a series at the asked places, and its noise's variance."""
    noise = float(NOISE_SHARES[share] + given.mixture.floor[series])
    values, places = given.mixture.values[:, series].numpy(), given.mixture.repetitions.numpy()
    mean, covariance, scale = oracle.conditional(kernel.numpy(), noise, values, places)
    return torch.from_numpy(mean), torch.from_numpy(covariance), scale * noise


def test_hypotheses_of_opposite_signs_do_not_cancel_in_the_estimate():
    """The estimate has the sign of the mean and at least its magnitude; with one hypothesis it is the mean."""
    given = model(elastic=True)
    mean, estimate = given.predict(ASKED.points, ASKED.directions), given.point_estimate(ASKED.points, ASKED.directions)
    for one, other in ((mean.mean.real, estimate.mean.real), (mean.mean.imag, estimate.mean.imag)):
        assert torch.equal(one.sign(), other.sign())
        assert bool((other.abs() >= one.abs() * (1 - 1e-5)).all())
    assert float((estimate.power / mean.power).max()) > 1.01
    best = given.mixture.weights.flatten(0, 1)
    single = torch.zeros_like(best).scatter_(0, best.argmax(0, keepdim=True), 1.0).reshape(given.mixture.weights.shape)
    sure = replace(given, mixture=replace(given.mixture, weights=single))
    both = sure.predict(ASKED.points, ASKED.directions), sure.point_estimate(ASKED.points, ASKED.directions)
    assert torch.allclose(both[0].parts, both[1].parts, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("elastic", [True, False])
def test_mean_and_deviation_are_those_of_all_hypotheses(elastic):
    given = model(elastic=elastic)
    kernels = joint_kernels(given)
    mean = torch.zeros(len(ASKED), 2 * MODES, dtype=torch.float64)
    square = torch.zeros_like(mean)
    for row, share, series in torch.nonzero(given.mixture.weights).tolist():
        location, covariance, _ = dense(given, kernels[row], share, series)
        mean[:, series] += given.mixture.weights[row, share, series] * location
        square[:, series] += given.mixture.weights[row, share, series] * (covariance.diagonal() + location.square())
    deviation = (square - mean.square()).sqrt()
    assert torch.allclose(series_of(gains_at(given)), mean, rtol=1e-5, atol=1e-6)
    found = deviation_at(given)
    assert torch.allclose(torch.cat([found[..., 0], found[..., 1]], dim=1), deviation, rtol=1e-4, atol=1e-6)


def test_the_deviation_does_not_depend_on_the_batches(monkeypatch):
    whole, other = deviation_at(model()), replace(model())
    monkeypatch.setattr(module, "_MEMORY", 0)
    assert torch.allclose(deviation_at(other), whole, rtol=1e-6, atol=1e-9)


def torn() -> MixtureGains:
    """Return the model with weights that differ between parts: the real one, of more energy, prefers the first."""
    weights = torch.zeros_like(model().mixture.weights)
    real = torch.arange(2 * MODES) < MODES
    weights[0, 1], weights[-1, 1] = torch.where(real, 0.6, 0.1), torch.where(real, 0.4, 0.9)
    return replace(model(), mixture=replace(model().mixture, weights=weights))


@pytest.mark.parametrize("make", [model, lambda: model(elastic=False), torn])
def test_covariances_are_those_of_the_most_probable_hypothesis(make):
    """Weighed by the energies of both parts, whose variances add up."""
    given = make()
    values, kernels = series_of(given.values), joint_kernels(given)
    found = list(given.covariances(ASKED.points, ASKED.directions))
    assert sorted(mode for mode, _, _ in found) == list(range(MODES))
    for mode, covariance, noise in found:
        parts = [mode, mode + MODES]
        weight = sum(given.mixture.weights[..., part] * values[:, part].square().sum() for part in parts)
        row, share = divmod(int(weight.flatten().argmax()), len(NOISE_SHARES))
        both = [dense(given, kernels[row], share, part) for part in parts]
        assert torch.allclose(covariance, sum(part[1] for part in both), rtol=1e-6, atol=1e-9)
        assert noise == pytest.approx(sum(part[2] for part in both), rel=1e-9)
        assert float(torch.linalg.eigvalsh(covariance).min()) > -1e-9 * noise


def test_shares_are_of_the_families_that_modes_come_from():
    shares = model().shares()
    assert torch.allclose(shares.sum(0), torch.ones(MODES, dtype=torch.float64))
    kinds = [family.kind for family in model().families]
    assert [kinds[row] for row in shares.argmax(0).tolist()][:4] == ["elastic", "smooth", "elastic", "elastic"]
    assert float(shares.amax(0)[:4].min()) > 0.9


def test_one_contact_leaves_families_as_probable_as_they_were():
    """Its gain may be of any scale, so it says nothing of the kernels; families of one kind share its probability."""
    sites = impacts(1, seed=1)
    unstructured, smooth, thin_plate = families(sites, elastic=False)
    given = fit_mixture(
        [unstructured, smooth, smooth, thin_plate], measured(sites), sites.points.float(), directional=True
    )
    expected = torch.tensor([0.05, 0.5, 0.5, 1.0], dtype=torch.float64) / 2.05
    assert torch.allclose(given.shares(), expected[:, None].expand(-1, MODES), rtol=1e-9)


@pytest.mark.parametrize("variance", [0.0, 1e-5, 100.0])
def test_a_mode_without_gains_is_silent_and_changes_no_other(variance):
    sites = impacts(12, seed=1)
    gains, points = measured(sites), sites.points.float()
    values = gains.values.clone()
    values[:, 2] = 0.0
    others = torch.tensor([0, 1, 3, 4])
    silent = replace(gains, values=values, variance=torch.where(torch.arange(MODES) == 2, variance, gains.variance))
    rest = replace(
        gains, **{name: getattr(gains, name)[..., others] for name in ("values", "variance", "frequency", "damping")}
    )
    one = fit_mixture(families(sites, elastic=False), silent, points, directional=True)
    other = fit_mixture(families(sites, elastic=False), rest, points, directional=True)
    assert not gains_at(one)[:, 2].any()
    assert torch.equal(deviation_at(one)[:, 2], torch.zeros(len(ASKED), 2, dtype=torch.float64))
    assert bool(one.standardized_errors()[:, 2].isnan().all())
    assert not one.leave_one_out()[:, 2].any()
    assert torch.allclose(gains_at(one)[:, others], gains_at(other), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("factor", [-2.5, 1e-4])
def test_scaled_gains_scale_the_model(factor):
    sites = impacts(12, seed=1)
    gains = measured(sites)
    scaled = replace(gains, values=factor * gains.values, variance=factor**2 * gains.variance)
    one, other = (
        fit_mixture(families(sites), each, sites.points.float(), directional=True) for each in (gains, scaled)
    )
    assert torch.allclose(gains_at(other), factor * gains_at(one), rtol=1e-5, atol=1e-6 * abs(factor))
    assert torch.allclose(deviation_at(other), abs(factor) * deviation_at(one), rtol=1e-4, atol=1e-6 * abs(factor))
    assert torch.allclose(other.noise(), abs(factor) * one.noise(), rtol=1e-5)


def test_without_contacts_the_rest_predicts():
    given = replace(model(), measured=2.0 * model().values)
    none = given.without(torch.zeros(14, dtype=torch.bool))
    assert torch.allclose(gains_at(none), gains_at(given), rtol=1e-6, atol=1e-7)
    left_out = torch.arange(14) % 3 == 1
    rest = given.without(left_out)
    assert torch.equal(rest.contacts, given.contacts[~left_out])
    assert torch.equal(rest.values, given.values[~left_out])
    assert torch.equal(rest.measured, given.measured[~left_out])
    # As if their noise were without bounds, with the same weights.
    kernels = joint_kernels(rest)
    mean = torch.zeros(len(ASKED), 2 * MODES, dtype=torch.float64)
    for row, share, series in torch.nonzero(rest.mixture.weights).tolist():
        mean[:, series] += rest.mixture.weights[row, share, series] * dense(rest, kernels[row], share, series)[0]
    assert torch.allclose(series_of(gains_at(rest)), mean, rtol=1e-5, atol=1e-6)


def test_mode_shapes_predict_what_positions_cannot_and_know_how_well():
    """Of shapes that are known at few places."""
    sites, asked = impacts(8, seed=1), impacts(60, seed=5)
    gains, true = measured(sites, noise=0.01), measured(asked, noise=0.0).values
    recipes = (families(sites, elastic=each) for each in (True, False))
    fits = [fit_mixture(each, gains, sites.points.float(), directional=True) for each in recipes]
    own, other = (gains_at(each, asked) - true for each in fits)
    shaped, smooth = ((each.abs().square().mean(0) / true.abs().square().mean(0)).sqrt() for each in (own, other))
    assert float(smooth.min()) > 0.3
    assert float(shaped.max()) < 0.1
    within = torch.view_as_real(own).abs() < 1.645 * deviation_at(fits[0], asked)
    # Of draws from the model .9; shapes that are exact leave less unknown than the hypotheses allow for.
    assert float(within.double().mean()) > 0.85


def test_two_impacts_near_each_other_that_differ_do_not_make_gains_run_away():
    sites = impacts(12, seed=1).take(torch.tensor([*range(12), 0]))
    sites.points[12, 0] += 1e-4
    gains = measured(sites)
    size = float(gains.values.abs().max())
    gains.values[12] = gains.values[0] + size
    given = fit_mixture(families(sites, elastic=False), gains, sites.points.float(), directional=True)
    assert given.place_count == 12
    # A slope of their difference over a tenth of a millimeter would reach a thousand times as far.
    assert float(gains_at(given).abs().max()) < 3.0 * size


def test_impacts_in_one_place_have_their_mean_there():
    sites = impacts(1, seed=1).take(torch.zeros(4, dtype=torch.int64))
    noise = 0.02 * torch.tensor([1.0, -1.0, 2.0, -2.0], dtype=torch.float64)[:, None]
    gains, exact = measured(sites), measured(sites.take(torch.tensor([0])), noise=0.0).values
    given = fit_mixture(
        families(sites, elastic=False), replace(gains, values=exact * (1.0 + noise)), sites.points.float(),
        directional=True,
    )  # fmt: skip
    assert given.place_count == 1
    found = gains_at(given, sites)
    torch.testing.assert_close(found, exact.expand(4, -1), rtol=0, atol=0.05 * float(exact.abs().max()))
    assert bool(gains_at(given).isfinite().all())
    assert bool(deviation_at(given).isfinite().all())


@pytest.mark.parametrize("moved", [0.0, 1e-6, 1e-3])
def test_repeated_recordings_leave_the_deviation_as_it_is(moved):
    sites = impacts(10, seed=1)
    once, rows = measured(sites), torch.arange(10).repeat(4)
    again = sites.take(rows)
    again = replace(again, points=again.points + moved * draw(40, 3, seed=5))

    def deviation(sites: Sites, gains: MeasuredGains) -> float:
        given = fit_mixture(families(sites, elastic=False), gains, sites.points.float(), directional=True)
        return float(deviation_at(given).median())

    assert deviation(again, once.take(rows)) == pytest.approx(deviation(sites, once), rel=0.25)
