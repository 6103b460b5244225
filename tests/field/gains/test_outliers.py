"""Wrong labels contradict the other contacts, right ones do not, and where places say nothing nobody is accused."""

import math
from dataclasses import replace

import pytest
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.outliers import (
    WIDE_NOISE_SHARES,
    Credibility,
    Fit,
    Outlier,
    PredictiveRatios,
    assess_contacts,
    predicts_better,
    set_aside,
)
from factories.made_fields import POSITIONAL, draw
from oracles import gain_model as oracle

CONTACTS, MODES = 20, 12


UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


def ratios_of_all(ratios: PredictiveRatios, aside: frozenset[int]) -> torch.Tensor:
    """Return L_i(S) of all contacts, S being `aside` without i itself."""
    found = ratios.without(aside)[0]
    for row in aside:
        found[row] = ratios.without(aside - {row})[0][row]
    return found


def _sites(count: int = CONTACTS) -> Sites:
    """Impacts on the unit square, all along z."""
    generator = torch.Generator().manual_seed(3)
    points = torch.cat([torch.rand(count, 2, generator=generator), torch.zeros(count, 1)], dim=1).double()
    return Sites(points, UP.expand(count, 3))


def _gains(sites: Sites, *, noise: float = 0.02) -> MeasuredGains:
    """Gains of plane waves of long wavelengths, as a supported plate's lowest modes have them."""
    generator = torch.Generator().manual_seed(5)
    wave = 3.0 * torch.rand(MODES, 3, generator=generator, dtype=torch.float64)
    phase = 2.0 * math.pi * torch.rand(MODES, generator=generator, dtype=torch.float64)
    values = torch.cos(sites.points @ wave.T + phase) * sites.directions[:, 2:]
    error = torch.randn(*values.shape, 2, generator=generator, dtype=torch.float64) * noise
    gains = torch.complex(values + error[..., 0], 0.3 * values + error[..., 1])
    frequency, damping = (torch.linspace(*ends, MODES, dtype=torch.float64) for ends in ((100.0, 2000.0), (2.0, 20.0)))
    return MeasuredGains(gains, torch.full((MODES,), noise**2, dtype=torch.float64), frequency, damping)


def _fit(sites: Sites, measured: MeasuredGains) -> Fit:
    def fit(rows: Int[Tensor, " rows"], noise_shares: tuple[float, ...]) -> MixtureGains:
        families, points = [kind(sites.take(rows), 1.4) for kind in POSITIONAL], sites.points.float()
        return fit_mixture(families, measured.take(rows), points, directional=True, noise_shares=noise_shares)

    return fit


def _places() -> Sites:
    one = torch.linspace(0.0, 1.0, 12, dtype=torch.float64)
    grid = torch.cartesian_prod(one, one, torch.zeros(1, dtype=torch.float64))
    return Sites(grid, UP.expand(len(grid), 3))


def _found(sites: Sites, measured: MeasuredGains) -> list[Outlier]:
    return assess_contacts(_fit(sites, measured), None, sites, _places(), measured)[0]


def _exchanged(sites: Sites, one: int, other: int) -> Sites:
    rows = torch.arange(len(sites))
    rows[[one, other]] = rows[[other, one]]
    return sites.take(rows)


def _dense_ratio(ratios: PredictiveRatios, row: int, others: list[int]) -> float:
    """The definition: each contact given the others, series by series."""
    rows = [*others, row]
    return sum(
        float(weight) * oracle.log_predictive_ratio(covariance[rows][:, rows].numpy(), 0.0, values[rows].numpy())
        for weight, covariance, values in zip(ratios.weight, ratios.covariance, ratios.values.T, strict=True)
    )


def _ratios() -> PredictiveRatios:
    sites = _sites(9)
    measured = _gains(sites, noise=0.1)
    return PredictiveRatios(_fit(sites, measured)(torch.arange(len(sites)), WIDE_NOISE_SHARES), sites, measured)


def test_ratio_is_that_of_student_densities_given_the_other_contacts() -> None:
    ratios = _ratios()
    for aside in (frozenset[int](), frozenset({2, 7})):
        others = ([each for each in range(9) if each != row and each not in aside] for row in range(9))
        expected = [_dense_ratio(ratios, row, given) for row, given in enumerate(others)]
        assert ratios_of_all(ratios, aside).tolist() == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_ratios_with_one_more_set_aside_and_at_another_site_are_those_computed_anew() -> None:
    ratios, aside = _ratios(), frozenset({4})
    _, pairs = ratios.without(aside)
    for other in (0, 8):
        expected = ratios.without(aside | {other})[0]
        torch.testing.assert_close(pairs[:, other], expected, rtol=1e-9, atol=1e-9, equal_nan=True)
    for row in (1, 4):
        same = ratios.elsewhere(row, aside, ratios.sites.take(torch.tensor([row])))[0, 0]
        torch.testing.assert_close(same, ratios_of_all(ratios, aside)[row], rtol=1e-9, atol=1e-9)


def test_right_labels_are_not_accused() -> None:
    sites = _sites()
    assert _found(sites, _gains(sites)) == []


def test_exchanged_labels_are_found_with_the_places_exchanged() -> None:
    true = _sites()
    labels = _exchanged(true, 9, 16)
    found = {each.row: each for each in _found(labels, _gains(true))}
    assert set(found) == {9, 16}
    for row in found:
        # Within two steps of the grid of where it was really hit.
        apart = torch.tensor(found[row].place, dtype=torch.float64) - true.points[row]
        assert float(apart.norm()) < 2.0 / 11.0
    names = tuple(f"hit{row}" for row in range(CONTACTS))
    train = Impacts(labels.points.float(), torch.zeros(CONTACTS, 1), 1.0, names, labels.directions.float())
    assert "hit16" in found[9].describe(train, with_body=False)


def test_a_recording_of_another_gain_is_named_as_such() -> None:
    true, gains = _sites(), _gains(_sites())
    gains.values[6] *= 0.1
    (found,) = _found(true, gains)
    assert found.row == 6
    assert abs(found.level_db + 20.0) < 2.0


def test_a_reversed_direction_is_found_at_its_own_place() -> None:
    true = _sites()
    directions = true.directions.clone()
    directions[6] = -directions[6]
    (found,) = _found(Sites(true.points, directions), _gains(true))
    assert found.row == 6
    assert found.reversed
    assert found.distance < 1.0 / 11.0


def test_noise_accuses_nobody() -> None:
    sites = _sites()
    measured = _gains(sites)
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        # Steps of a factor of ten between contacts: some fit badly wherever they are.
        size = 10.0 ** torch.randint(0, 2, (CONTACTS, 1), generator=generator)
        noise = torch.randn(CONTACTS, MODES, dtype=torch.complex128, generator=generator) * size
        assert _found(sites, replace(measured, values=noise)) == []


def test_few_places_accuse_nobody() -> None:
    sites = _sites(5).take(torch.arange(5).repeat(2))
    measured, directions = _gains(sites), sites.directions.clone()
    directions[6] = -directions[6]
    assert _found(Sites(sites.points, directions), measured) == []


def test_gains_that_no_place_explains_are_no_wrong_label() -> None:
    sites = _sites()
    measured = _gains(sites)
    generator = torch.Generator().manual_seed(0)
    measured.values[6] = 5.0 * torch.randn(MODES, dtype=torch.complex128, generator=generator)
    ratios = PredictiveRatios(_fit(sites, measured)(torch.arange(len(sites)), WIDE_NOISE_SHARES), sites, measured)
    assert 6 in set_aside(ratios)
    assert _found(sites, measured) == []


def test_leaving_wrong_labels_out_predicts_the_others_better_and_right_ones_not() -> None:
    true = _sites()
    rows = torch.tensor([row for row in range(CONTACTS) if row not in (9, 16)])
    for labels, better in ((_exchanged(true, 9, 16), True), (true, False)):
        measured = _gains(true)
        fit = _fit(labels, measured)
        fewer, whole = fit(rows, NOISE_SHARES), fit(torch.arange(CONTACTS), NOISE_SHARES)
        found = predicts_better(fewer.leave_one_out(), whole.leave_one_out()[rows], measured.take(rows))
        assert found == better


@pytest.mark.parametrize(("with_body", "without", "credible"), [(0.8, 0.4, True), (0.6, 0.1, False), (2.0, 1.9, False)])
def test_body_has_to_predict_and_to_add(with_body: float, without: float, credible: bool) -> None:
    assert Credibility(with_body, without).credible == credible


def test_a_contact_near_a_support_does_not_outweigh_the_others():
    gains = draw(12, 5, seed=0).to(torch.complex128)
    # A body that moves there is as wrong as can be, and no more.
    gains[-1] *= 1e-6
    measured = MeasuredGains(
        gains, torch.full((5,), 1e-5).double(), torch.arange(1.0, 6.0).double() * 100, torch.full((5,), 10.0).double()
    )
    held = gains + 0.2 * draw(12, 5, seed=1)
    free = gains + 0.8 * draw(12, 5, seed=2)
    assert predicts_better(held, free, measured)
    assert not predicts_better(free, held, measured)
    assert not predicts_better(gains + 0.8 * draw(12, 5, seed=3), free, measured)


def test_errors_that_fall_at_most_contacts_are_no_chance():
    # Of one mode at 12 contacts the errors fall at 9, and rise by as much at 3: by chance with a probability of .017.
    falls = torch.tensor([-0.035, -0.055, -0.075, *(0.02 * step for step in range(1, 10))], dtype=torch.float64)
    ones = torch.ones(12, 1, dtype=torch.complex128)

    def predicted(error: Float64[Tensor, " contacts"]) -> Tensor:
        """Gains p with |p - 1| / sqrt(1 + |p|^2) = error."""
        return ones + 1j * (error * (2 / (1 - error.square())).sqrt())[:, None]

    one = torch.ones(1, dtype=torch.float64)
    new, old, measured = predicted(0.3 + 0 * falls), predicted(0.3 + falls), MeasuredGains(ones, one, one, one)
    assert predicts_better(new, old, measured)
    assert not predicts_better(old, new, measured)


def test_a_repeated_recording_does_not_count_as_predicted_by_its_place() -> None:
    rows = torch.arange(12).repeat(2)
    sites = _sites(12).take(rows)
    gains = replace(_gains(_sites(12)), values=torch.view_as_complex(draw(12, MODES, 2, seed=2))).take(rows)
    ratios = PredictiveRatios(_fit(sites, gains)(torch.arange(24), WIDE_NOISE_SHARES), sites, gains)
    assert ratios.mean() < 0.3
