"""Splines as gain fields: kriging against its definition, and doubt that is as large as the errors are."""

from dataclasses import replace

import pytest
import torch

from avmsf.errors import FitError
from avmsf.field import thinplate
from avmsf.field.thinplate import NEAR, SplineSites, fit_spline
from avmsf.field.thinplategains import ThinPlateGains, thin_plate_gains

BOX = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)


def scattered(count: int, *, seed: int = 0, flat: bool = False) -> torch.Tensor:
    drawn = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * BOX
    # In the order in which places are told apart.
    return torch.unique(drawn * torch.tensor([1.0, 1.0, 0.0]) if flat else drawn, dim=0)


def made(contacts: torch.Tensor, *, modes: int = 3, noise: float = 0.0) -> ThinPlateGains:
    generator = torch.Generator().manual_seed(1)
    waves = torch.sin(contacts @ (15.0 * torch.randn(3, 2 * modes, dtype=torch.float64, generator=generator)))
    values = waves + noise * torch.randn(waves.shape, dtype=torch.float64, generator=generator)
    return thin_plate_gains(
        contacts, values.reshape(-1, modes, 2), importance=torch.ones(modes), points=scattered(50, seed=2)
    )


def covariance(places: torch.Tensor, others: torch.Tensor, sites: SplineSites) -> torch.Tensor:
    """Return the generalised covariance of the random field behind a spline: r^2 log r, or minus r."""
    distance = torch.cdist(places, others, compute_mode="donot_use_mm_for_euclid_dist") / length(sites)
    return torch.special.xlogy(distance.square(), distance) if sites.bending else -distance


def length(sites: SplineSites) -> float:
    """Return what distances are relative to, metres."""
    return 1.0 / float(sites.axes.norm(dim=0)[0])


@pytest.mark.parametrize(("count", "smoothing"), [(5, 0.0), (12, 0.0), (20, 0.0), (20, 0.03)])
def test_spread_is_the_least_variance_that_weights_can_have(count, smoothing):
    """The definition of kriging: weights that get linear functions right, and among these err least."""
    contacts, asked = scattered(count), scattered(9, seed=3)
    sites = SplineSites(contacts, smoothing)
    known = covariance(contacts, contacts, sites) + smoothing * torch.eye(count, dtype=torch.float64)

    def variance(weights: torch.Tensor) -> torch.Tensor:
        across = covariance(asked, contacts, sites)
        return ((weights @ known) * weights).sum(1) - 2 * (weights * across).sum(1)

    weights = sites.weights(asked)
    assert torch.allclose(weights.sum(1), torch.ones(9, dtype=torch.float64), rtol=0, atol=1e-9)
    if sites.bending:
        assert torch.allclose(weights @ contacts, asked, rtol=0, atol=1e-9)
    assert torch.allclose(sites.spread(asked), variance(weights), rtol=0, atol=1e-9)
    # Other weights that are as right about linear functions err more.
    drift = torch.cat([torch.ones(count, 1, dtype=torch.float64), contacts if sites.bending else contacts[:, :0]], 1)
    aside = torch.randn(9, count, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    aside = aside - aside @ drift @ torch.linalg.pinv(drift)
    for step in (0.01, -0.01, 1.0):
        assert bool((variance(weights + step * aside) > sites.spread(asked)).all())


@pytest.mark.parametrize(("count", "flat"), [(5, False), (12, False), (12, True), (20, False)])
def test_errors_and_variances_of_sites_left_out_are_those_of_really_leaving_them_out(count, flat):
    contacts = scattered(count, flat=flat)
    whole, values = SplineSites(contacts, 0.0), torch.sin(30.0 * contacts)
    errors, variances = torch.empty_like(values), torch.empty(count, dtype=torch.float64)
    for row in range(count):
        kept = [each for each in range(count) if each != row]
        part = SplineSites(contacts[kept], 0.0)
        assert part.bending == whole.bending
        errors[row] = values[row] - (part.weights(contacts[row : row + 1]) @ values[kept])[0]
        # Each measures distances in an extent of its own: r^2 log r by its square, r by itself.
        power = 2 if whole.bending else 1
        variances[row] = part.spread(contacts[row : row + 1])[0] * (length(part) / length(whole)) ** power
    assert torch.allclose(whole.left_out(values), errors, rtol=0, atol=1e-8)
    expected = (errors.square() / variances[:, None]).mean(0)
    torch.testing.assert_close(whole.field_variance(values), expected, rtol=1e-7, atol=0)


def test_what_splines_pass_through_is_not_doubted_and_what_is_far_is():
    contacts = scattered(12)
    field = made(contacts)
    assert field.smoothing == 0.0
    size = float(field.values.abs().max())
    between = field.deviation(scattered(30, seed=3))
    # The root of what float64 leaves of zero.
    assert float(field.deviation(contacts).max()) < 1e-5 * size
    assert float(between.min()) > 1e-3 * size
    away = contacts[:1] + torch.linspace(0.0, 3.0, 13, dtype=torch.float64)[:, None] * (contacts[:1] - BOX / 2)
    assert bool((field.deviation(away).diff(dim=0) > 0).all())


def test_smoothed_splines_are_doubted_at_their_contacts_too():
    field = made(scattered(24), noise=1.0)
    assert field.smoothing > 0.0
    assert float(field.deviation(field.contacts).min()) > 0.01 * float(field.values.abs().max())


@pytest.mark.parametrize(("count", "flat"), [(6, False), (14, True), (15, False)])
def test_doubt_is_as_large_as_the_errors_are(count, flat):
    """Gains drawn from the very random field whose mean splines are: means over three thousand modes."""
    contacts, asked, modes = scattered(count, flat=flat), scattered(8, seed=5, flat=flat), 1500
    sites, everywhere = SplineSites(contacts, 0.0), torch.cat([contacts, asked])
    drift = torch.cat([torch.ones(len(everywhere), 1, dtype=torch.float64), everywhere], dim=1)
    drift = drift if sites.bending else drift[:, :1]
    aside = torch.eye(len(everywhere), dtype=torch.float64) - drift @ torch.linalg.pinv(drift)
    # Of the field nothing is known but what is no linear function; there its covariance is a proper one.
    squares, axes = torch.linalg.eigh(aside @ covariance(everywhere, everywhere, sites) @ aside)
    assert float(squares.min()) > -1e-9
    chance = torch.randn(len(everywhere), 2 * modes, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
    drawn = axes @ (squares.clamp_min(0.0).sqrt()[:, None] * chance)
    field = thin_plate_gains(contacts, drawn[:count].reshape(-1, modes, 2), importance=torch.ones(modes), points=asked)
    known = field.at(asked)
    errors = torch.stack([known.mean, known.quadrature], dim=2).double() - drawn[count:].reshape(-1, modes, 2)
    foretold = field.deviation(asked).double().square().mean((1, 2))
    # Each mean square of 3000 is known to 2.6 %, three times that is allowed.
    torch.testing.assert_close(errors.square().mean((1, 2)), foretold, rtol=0.08, atol=0)


def test_doubt_belongs_to_the_object_and_scales_with_its_gains():
    contacts, asked = scattered(12), scattered(9, seed=3)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))).Q
    field = made(contacts)
    moved, elsewhere = (4.0 * each @ turn.T + torch.tensor([1.0, -2.0, 0.5]) for each in (contacts, asked))
    there = replace(field, contacts=moved)
    torch.testing.assert_close(there.deviation(elsewhere), field.deviation(asked), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(there.at(elsewhere).mean, field.at(asked).mean, rtol=1e-5, atol=1e-5)
    louder = field.with_values(7.0 * field.values)
    torch.testing.assert_close(louder.deviation(asked), 7.0 * field.deviation(asked), rtol=1e-5, atol=0)


def test_contacts_in_one_place_say_nothing_of_how_gains_vary():
    again = scattered(1).expand(3, -1)
    field = thin_plate_gains(
        again, torch.arange(6.0, dtype=torch.float64).reshape(3, 1, 2), importance=torch.ones(1), points=scattered(4)
    )
    assert field.deviation(scattered(5, seed=3)) is None
    # The mean of what was measured there.
    assert torch.equal(field.at(scattered(5, seed=3)).mean, torch.full((5, 1), 2.0))
    assert torch.equal(field.at(scattered(5, seed=3)).quadrature, torch.full((5, 1), 3.0))


def test_standard_errors_are_what_smoothing_leaves_and_two_hundredths_at_least():
    exact, smoothed = made(scattered(12)), made(scattered(24), noise=1.0)
    size = exact.values.square().mean((0, 2)).sqrt()
    torch.testing.assert_close(exact.noise, (0.02 * size[:, None]).expand(12, 3, 2))
    known = smoothed.at(smoothed.contacts)
    left = smoothed.values - torch.stack([known.mean, known.quadrature], dim=2)
    torch.testing.assert_close(smoothed.noise[5], left.square().mean(0).sqrt(), rtol=1e-5, atol=0)


def test_splines_say_what_they_are():
    assert made(scattered(12)).report == {"kernel": "thin plate", "smoothing": 0.0}
    assert made(scattered(5)).report == {"kernel": "distance", "smoothing": 0.0}


def test_splines_without_contacts_are_refused():
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    with pytest.raises(FitError, match="without any contact; give at least one"):
        thin_plate_gains(nothing, nothing.reshape(0, 2, 2), importance=torch.ones(2), points=scattered(4))


@pytest.mark.parametrize("count", [4, 12])
@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_what_is_not_known_of_places_has_the_spread_on_its_diagonal(count, smoothing):
    generator = torch.Generator().manual_seed(5)
    contacts, places = (torch.rand(rows, 3, generator=generator, dtype=torch.float64) for rows in (count, 7))
    sites = SplineSites(contacts, smoothing)
    covariance = sites.covariance(places)
    assert torch.allclose(torch.diagonal(covariance), sites.spread(places), rtol=1e-6, atol=1e-9)
    assert torch.allclose(covariance, covariance.T, atol=1e-9)


def beside(contacts: torch.Tensor, part: float) -> torch.Tensor:
    """Return a place beside the first contact, so far over the diagonal of the box around all."""
    size = float((contacts.amax(0) - contacts.amin(0)).norm())
    return contacts[:1] + part * size * torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)


@pytest.mark.parametrize("count", [9, 20])
def test_two_blows_beside_each_other_that_differ_do_not_make_gains_run_away(count):
    contacts, asked = scattered(count), scattered(400, seed=7)
    values = torch.sin(20.0 * contacts[:, :1])
    near = torch.cat([contacts, contacts[:1] + torch.tensor([[1e-4, 0.0, 0.0]], dtype=torch.float64)])
    both = torch.cat([values, values[:1] + 2.0])
    found = fit_spline(near, both, importance=torch.ones(1)).at(asked)
    mean = torch.cat([values[:1] + 1.0, values[1:]])
    expected = fit_spline(contacts, mean, importance=torch.ones(1)).at(asked)
    # What a tenth of a millimetre moves the site by changes little; the slope of 2 over it would be 20 a millimetre.
    assert float((found - expected).abs().max()) < 0.02
    assert float(found.abs().max()) < 6.0


@pytest.mark.parametrize(("count", "flat"), [(9, False), (20, False), (20, True)])
def test_no_value_counts_for_much_more_than_itself_however_near_its_neighbour_is(count, flat):
    contacts, asked = scattered(count, flat=flat), scattered(400, seed=7, flat=flat)
    for part in (1e-5, 1e-3, 0.5 * NEAR, 0.99 * NEAR, 1.01 * NEAR, 2 * NEAR):
        aside = beside(contacts, part)
        near = torch.cat([contacts, aside * torch.tensor([1.0, 1.0, 0.0]) if flat else aside])
        assert float(SplineSites(near, 0.0).weights(asked).abs().amax()) < 20.0


def test_contacts_near_each_other_are_one_site_and_a_row_of_them_is_not():
    contacts = scattered(12)
    assert len(SplineSites(torch.cat([contacts, beside(contacts, 0.9 * NEAR)]), 0.0).sites) == 12
    assert len(SplineSites(torch.cat([contacts, beside(contacts, 1.1 * NEAR)]), 0.0).sites) == 13
    line = torch.linspace(0.0, 0.1, 251, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 0.0, 0.0]])
    sites = SplineSites(line.double(), 0.0)
    # Each is near to the next; no site is longer than what is near.
    assert 100 <= len(sites.sites) <= 200
    reach = torch.stack([(line[rows > 0].amax(0) - line[rows > 0].amin(0)).norm() for rows in sites._places[1]])
    assert float(reach.max()) <= NEAR * 0.1 + 1e-12
    # Whatever their order.
    rows = torch.randperm(251, generator=torch.Generator().manual_seed(3))
    shuffled = SplineSites(line[rows].double(), 0.0)
    assert torch.allclose(shuffled.weights(contacts)[:, rows.argsort()], sites.weights(contacts), rtol=0, atol=1e-6)


def test_a_mean_of_several_blows_is_smoothed_as_much_less():
    """Penalised least squares on all blows, solved as such, is the spline through means with their noise."""
    contacts, smoothing = scattered(14), 0.05
    again = torch.cat([contacts, contacts[:3], contacts[:1]])
    values = torch.randn(18, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(8))
    sites = SplineSites(again, smoothing)
    kernel = covariance(contacts, contacts, sites)
    drift = torch.cat([torch.ones(14, 1, dtype=torch.float64), contacts], dim=1)
    owner = torch.tensor([*range(14), 0, 1, 2, 0])
    # Weights that are orthogonal to linear functions, and the linear function.
    free = torch.linalg.svd(drift.T)[2][4:].T
    terms = torch.cat([kernel @ free, drift], dim=1)
    bent = torch.zeros(14, 14, dtype=torch.float64)
    bent[:10, :10] = free.T @ kernel @ free
    solved = torch.linalg.solve(terms[owner].T @ terms[owner] + smoothing * bent, terms[owner].T @ values)
    expected = terms @ solved
    assert torch.allclose(sites.weights(contacts) @ values, expected, rtol=0, atol=1e-8)


def test_a_site_of_several_blows_is_left_out_with_all_of_them():
    contacts = scattered(13)
    near = torch.cat([contacts, beside(contacts, 0.3 * NEAR)])
    values = torch.sin(30.0 * near[:, :1])
    values[-1] += 0.5
    sites = SplineSites(near, 0.0)
    part = SplineSites(contacts[1:], 0.0)
    middle, mean = (near[0] + near[-1]) / 2, (values[0] + values[-1]) / 2
    error = mean - (part.weights(middle[None]) @ values[1:13])[0]
    assert len(sites.left_out(values)) == 13
    assert float(sites.left_out(values)[0]) == pytest.approx(float(error), abs=1e-8)


def test_many_places_are_asked_a_batch_at_a_time(monkeypatch: pytest.MonkeyPatch):
    sites, asked = SplineSites(scattered(12), 0.0), scattered(50, seed=3)
    whole = sites.weights(asked)
    sizes = []
    kernel = thinplate._kernel

    def counted(places: torch.Tensor, others: torch.Tensor, bending: bool) -> torch.Tensor:
        sizes.append(len(places))
        return kernel(places, others, bending)

    monkeypatch.setattr(thinplate, "_kernel", counted)
    monkeypatch.setattr(thinplate, "_MEMORY", 7 * 37)
    assert torch.equal(sites.weights(asked), whole)
    assert max(sizes) <= 8
