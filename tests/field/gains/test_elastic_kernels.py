"""The elastic family on a plate whose mode shapes are products of cosines: prediction, frequency factors, densities."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.stats import norm

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import MATERIALS
from avmsf.field.gains.elastic import (
    EQUAL_PRIOR,
    FACTORS,
    FREQUENCY_ERRORS,
    PERTURBATIONS,
    PROFILE_PRIOR,
    REACH,
    RESIDUAL_PRIOR,
    RESIDUALS,
    WIDTHS,
    Elastic,
)
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, fit_mixture, hypotheses_of, weigh_factors
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture import log_evidence
from avmsf.field.gains.model import series_of
from factories.made_fields import SIZE, draw, families, impacts, measured, plate
from oracles import gain_model as oracle

SHAPES = 6
PROFILES = len(PERTURBATIONS) + len(WIDTHS)


def family(count: int = 10) -> Elastic:
    return Elastic(impacts(count, seed=1), SIZE, plate())


def weighed(gains: MeasuredGains, sites: Sites, modes: ElasticModes | None = None, units: Sequence[float] = (1.0,)):
    """Return the family of the plate's modes, or of others, with the factors' probabilities by gains."""
    body = Elastic(sites, SIZE, modes or plate(), unit_ratios=units)
    weigh_factors([WeighedFamily.of(each, gains) for each in (*families(sites, elastic=False), body)], gains)
    return body


def bare(frequency: torch.Tensor) -> Elastic:
    """Return the family of a body of other frequencies, with the plate's shapes in turn."""
    shapes = plate().shapes[:, torch.arange(len(frequency)) % SHAPES]
    return Elastic(impacts(4, seed=1), SIZE, replace(plate(), frequency=frequency, shapes=shapes))


def test_kernels_are_the_written_ones():
    """Among the contacts and between them and other places."""
    given, frequency, others = family(), plate().frequency, impacts(5, seed=2)
    known = given.reference
    both = Sites.joined([known, others])
    shapes = plate().gains(both.points, both.directions)
    squares = (both.points[:, None] - known.points).square().sum(2)
    smooth = torch.exp(-0.5 * squares / (REACH * SIZE) ** 2) * both.cosine(known)
    kernels, count = given.between(both, known), len(known)
    assert len(kernels) == PROFILES * SHAPES * len(RESIDUALS)
    for profile, shape, remainder in product(range(PROFILES), range(SHAPES), range(len(RESIDUALS))):
        apart = torch.log(frequency / frequency[shape])
        if profile < len(PERTURBATIONS):
            nearness = 1.0 / (1.0 + (2.0 * apart / PERTURBATIONS[profile]) ** 2)
        else:
            nearness = torch.exp(-0.5 * (apart / WIDTHS[profile - len(PERTURBATIONS)]) ** 2) + 1e-3
        mixed = (shapes * nearness) @ shapes[:count].T
        share = RESIDUALS[remainder]
        expected = (1.0 - share) * mixed / mixed[:count].trace() * count + share * smooth
        row = (profile * SHAPES + shape) * len(RESIDUALS) + remainder
        assert torch.allclose(kernels[row], expected, rtol=1e-5, atol=1e-5)


def test_a_body_is_of_no_weight_for_what_it_does_not_have():
    """Its share of gains that are affine functions of the place is small; it takes nearly all of its own modes'."""
    sites = impacts(20, seed=1, askew=0.0)
    gains = measured(sites, noise=0.01)
    affine = -sites.directions[:, 2] * (1.0 + 30.0 * sites.points[:, 0] - 45.0 * sites.points[:, 1])
    foreign = replace(
        gains, values=affine[:, None] * torch.tensor([1.0, -0.3j, 0.5, 2.0, 1.0j], dtype=torch.complex128)
    )
    points = sites.points.float()
    own, other = (fit_mixture(families(sites), each, points, directional=True) for each in (gains, foreign))
    assert isinstance(own.families[-1], Elastic)
    assert float(own.shares()[-1].min()) > 0.95
    shares = other.shares()[-1] if isinstance(other.families[-1], Elastic) else torch.zeros(1)
    assert float(shares.max()) < 0.05


@pytest.mark.parametrize("factor", [0.3, 0.75, 1.0, 1.2])
def test_a_factor_on_all_frequencies_is_found(factor):
    sites = impacts(12, seed=1)
    elastic = weighed(measured(sites, factor=factor), sites)
    assert float(elastic.frequency_weights.sum()) == pytest.approx(1.0)
    # The frequencies are exact, and the factors considered 1 % apart.
    assert abs(math.log(elastic.factor / factor)) <= 0.01


def test_weak_modes_tell_the_factor_next_to_strong_ones_that_are_no_shapes():
    """Sixteen modes of a hundred times the gains, which follow no shape at frequencies far apart, say nothing of it."""
    sites = impacts(12, seed=1)
    weak, frequency = measured(sites, factor=0.75), torch.linspace(2500.0, 9000.0, 16, dtype=torch.float64)
    values = 100.0 * weak.values.abs().mean() * torch.view_as_complex(draw(12, 16, 2, seed=8))
    strong = MeasuredGains(values, torch.full((16,), 1e-5).double(), frequency, torch.full((16,), 20.0).double())
    both = MeasuredGains(
        *(torch.cat(each, dim=-1) for each in zip(vars(weak).values(), vars(strong).values(), strict=True))
    )
    assert abs(math.log(weighed(both, sites).factor / 0.75)) <= 0.01


def test_poles_with_the_patterns_of_shapes_at_other_frequencies_do_not_move_the_factor():
    """Eighteen weak ones above all modes, as stand for how strong modes begin, each with the gains of one of these."""
    sites = impacts(30, seed=1)
    modes = measured(sites)
    values = 0.05 * modes.values[:, [1, 3, 4] * 6]
    frequency = modes.frequency[-1] * torch.linspace(1.3, 2.0, 18, dtype=torch.float64)
    poles = MeasuredGains(values, torch.full((18,), 1e-5).double(), frequency, torch.full((18,), 60.0).double())
    both = MeasuredGains(
        *(torch.cat(each, dim=-1) for each in zip(vars(modes).values(), vars(poles).values(), strict=True))
    )
    assert abs(math.log(weighed(both, sites).factor)) <= 0.01


def match(body, log_frequency, shape=0.0):
    """Return densities by factor, error and mode, with the same evidence of all shapes."""
    evidence = torch.full((len(body.modes), len(log_frequency)), shape, dtype=torch.float64)
    return body.match(log_frequency, evidence).reshape(len(FACTORS), len(FREQUENCY_ERRORS), -1)


@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("computed", [30, 20])
def test_a_body_has_modes_above_those_that_were_computed(computed, seed):
    """Of 40 modes of a plate, at even spaces and up to half of one off, a part tells the factor in steps of 1 %."""
    true = torch.sort(400.0 * (torch.arange(1, 41, dtype=torch.float64) + draw(40, seed=seed))).values
    found = match(bare(true[:computed]), torch.log(true) + 0.07 * draw(40, seed=seed + 50))
    evidence = torch.logaddexp(found, torch.zeros(())).sum(2).amax(1)
    # The frequencies are 2 % off (standard deviation), each of many.
    assert abs(math.log(FACTORS[evidence.argmax()])) <= 0.03


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("factor", [0.2, 0.45])
def test_the_number_of_modes_above_grows_as_that_of_the_computed_ones(factor, power):
    """In proportion to the power of the frequency: those of a plate to the first, of a solid to the third."""
    body = bare(2700.0 * (torch.arange(1, 21, dtype=torch.float64) / 20.0) ** (1.0 / power))
    measured_modes = torch.log(torch.linspace(600.0, 3000.0, 9, dtype=torch.float64))
    low, high = float(measured_modes.min()) - 0.1, float(measured_modes.max()) + 0.1
    row = int((FACTORS - factor).abs().argmin())
    top = math.log(2700.0 * float(FACTORS[row]))

    def number(log_frequency):
        """Of shapes below a frequency, of all those that go on as the computed ones."""
        return 20.0 * np.exp(power * (log_frequency - top))

    center = top + np.log(np.arange(1, 21) / 20.0) / power
    total = ((center > low) & (center < high)).sum() + number(high) - number(max(low, top))
    # Over the density of a mode that is no shape, which follows the same law over all of the measured range.
    expected = np.where(measured_modes.numpy() > top, (number(high) - number(low)) / total, 0.0)
    # Gains exclude the computed shapes.
    found = match(body, measured_modes, shape=-1e9)[row]
    assert found.exp().numpy() == pytest.approx(np.broadcast_to(expected, found.shape), rel=1e-6)


@pytest.mark.parametrize("power", [0.5, 1, 3])
def test_a_frequency_among_many_shapes_says_nothing_of_whether_a_mode_is_one(power):
    """Shapes are much closer than the error of 3 or 8 %, and as dense at each frequency as the law has them."""
    body = bare(2700.0 * (torch.arange(1, 201, dtype=torch.float64) / 200.0) ** (1.0 / power))
    within = torch.log(torch.linspace(900.0, 2200.0, 9, dtype=torch.float64))
    inner = match(body, within)[int(FACTORS.log().abs().argmin()), 1:3, 2:-2]
    assert inner.numpy() == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("factor", [0.067, 1.8])
def test_no_factor_is_considered_that_no_material_has(factor):
    """Of the table, with 5 % for frequencies of real bodies and 20 % for the thickness: plastic to ceramic."""
    sites = impacts(12, seed=1)
    body = weighed(measured(sites, factor=factor), sites)
    slowest, *_, fastest = sorted(math.sqrt(each.young / each.density / (7e10 / 2700)) for each in MATERIALS.values())
    assert slowest / 1.05 / 1.2 <= body.factor <= fastest * 1.05 * 1.2


@pytest.mark.parametrize(("ratio", "unit"), [(1.0, 0), (0.3048, 1), (0.0254, 2), (0.01, 3)])
@pytest.mark.parametrize("factor", [0.75, 1.0])
def test_the_unit_is_inferred_where_none_is_stated(ratio, unit, factor):
    """A mesh in centimeters, read in meters, has frequencies a hundredth of the object's."""
    sites = impacts(12, seed=1)
    body = weighed(measured(sites, factor=factor / ratio), sites, units=(1.0, 0.3048, 0.0254, 0.01))
    assert body.unit == unit
    assert body.material_factor == pytest.approx(factor, rel=0.011)
    assert body.factor == pytest.approx(factor / ratio, rel=0.011)


def test_gains_tell_the_factor_where_frequencies_do_not():
    """Of frequencies in geometric progression, each is another's as well; which shape a mode is says whose."""
    progression = 400.0 * 1.3 ** torch.arange(SHAPES, dtype=torch.float64)
    sites = impacts(12, seed=1)
    gains = replace(measured(sites), frequency=1.3 * progression[:5])
    body = weighed(gains, sites, replace(plate(), frequency=progression))
    assert abs(math.log(body.factor / 1.3)) <= 0.05


@pytest.mark.parametrize(("scatter", "expected"), [(0.0, 0.01), (0.025, 0.03)])
def test_all_modes_together_tell_how_exact_the_frequencies_are(scatter, expected):
    sites = impacts(8, seed=1)
    gains = measured(sites)
    offsets = scatter * torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0], dtype=torch.float64)
    elastic = weighed(replace(gains, frequency=gains.frequency * offsets.exp()), sites)
    weights = elastic.frequency_weights.reshape(len(FACTORS), -1).sum(0)
    assert FREQUENCY_ERRORS[int(weights.argmax())] == expected


def test_the_density_of_a_frequency_is_averaged_over_factors_and_errors():
    """Half of the modes have the body's error, the others any; over that of a mode that is no shape.

    In the range of the measured modes, .1 wider at both ends, these are as dense as the upper half of the shapes.
    """
    given, measured_modes = family(3), torch.log(plate().frequency * 1.03)
    weights = draw(len(FACTORS) * len(FREQUENCY_ERRORS), seed=3) + 0.5
    given.frequency_weights = weights / weights.sum()
    low, high = float(measured_modes.min()) - 0.1, float(measured_modes.max()) + 0.1
    expected = np.zeros((SHAPES, SHAPES))
    for factor, each in zip(FACTORS.log(), given.frequency_weights.reshape(len(FACTORS), -1), strict=True):
        center = (factor + torch.log(plate().frequency)).numpy()
        inside = max(((center > low) & (center < high)).sum(), 1)
        for error, weight in zip(FREQUENCY_ERRORS, 0.5 * each + 0.5 * each.mean(), strict=True):
            density = norm.pdf(measured_modes.numpy(), center[:, None], error)
            expected += float(weight) * density / inside
    half = (SHAPES + 1) // 2
    power = math.log(SHAPES / half) / math.log(plate().frequency[-1] / plate().frequency[half - 1])
    expected /= power * np.exp(power * measured_modes.numpy()) / (np.exp(power * high) - np.exp(power * low))
    found = given.shape_log_prior(measured_modes)
    assert found.exp().numpy() == pytest.approx(expected, rel=1e-4)
    # It is that of each kernel around a shape.
    prior = given.log_prior(measured_modes).reshape(PROFILES, SHAPES, len(RESIDUALS), SHAPES)
    assert torch.equal(prior, found[None, :, None].expand_as(prior))


def test_the_factors_prior_is_a_probability_of_units_and_materials():
    prior = Elastic(impacts(4, seed=1), SIZE, plate(), unit_ratios=(1.0, 1000.0, 10.0)).factor_log_prior
    probability = prior.exp().reshape(3, len(FACTORS), -1).sum(2)
    assert float(probability.sum()) == pytest.approx(1.0)
    assert float(FACTORS[probability[0].argmax()]) == pytest.approx(1.0)
    # Materials are as probable in all units, and each other unit is as probable as the next.
    assert probability.sum(1).tolist() == pytest.approx([1 / 1.002, 0.001 / 1.002, 0.001 / 1.002])
    assert torch.allclose(probability[0] / probability[2], torch.tensor(1000.0, dtype=torch.float64))


def test_categories_are_profiles_and_remainders_of_their_probability():
    """With a probability that no typical one is, and all are equal."""
    given, rows = family(), product(range(PROFILES), range(SHAPES), range(len(RESIDUALS)))
    assert given.categories().tolist() == [profile * len(RESIDUALS) + remainder for profile, _, remainder in rows]
    typical = np.outer(PROFILE_PRIOR, RESIDUAL_PRIOR).flatten()
    expected = (1.0 - EQUAL_PRIOR) * typical / typical.sum() + EQUAL_PRIOR / len(typical)
    assert given.category_prior().tolist() == pytest.approx(expected.tolist(), rel=1e-6)
    gains = measured(impacts(10, seed=1), noise=0.01)
    found = hypotheses_of([WeighedFamily.of(given, gains, (0.01,))], gains)
    assert torch.allclose(found.category_prior, given.prior * given.category_prior(), rtol=1e-12)


def test_the_evidence_of_a_shape_is_that_of_its_kernels_by_their_probability():
    given = family()
    evidence = 10.0 * draw(len(given.shares), 3, 2, seed=5)
    prior = given.category_prior().log()[given.categories()][:, None]
    # Over noise shares, which are equally probable.
    joint = (evidence.logsumexp(1) - math.log(3) + prior).reshape(PROFILES, SHAPES, len(RESIDUALS), 2)
    assert torch.allclose(given.shape_evidence(evidence), joint.logsumexp((0, 2)), rtol=1e-12)


def test_a_shape_without_motion_at_the_impacts_is_not_visible():
    """Of unit remainders: the visibility is the shapes' mean square at the impacts over their mean."""
    given = family()
    size = plate().gains(given.reference.points, given.reference.directions).square().mean(0)
    narrowest = given.categories() == 0
    found = given.visibility()[narrowest]
    assert torch.allclose(found, (1.0 - RESIDUALS[0]) * size / size.mean() + RESIDUALS[0], rtol=0.1, atol=0.02)
    assert float(found.mean()) == pytest.approx(1.0, rel=1e-9)


def test_the_level_of_a_part_is_that_of_the_modes_near_in_frequency():
    """Of the informative parts: here all but those of a mode that is another one's double."""
    given = measured(impacts(6, seed=4))
    doubled = replace(given, frequency=given.frequency.index_fill(0, torch.tensor([1]), float(given.frequency[0]) + 1))
    counted = doubled.informative.reshape(2, -1).double().numpy()
    assert counted.sum() == 2 * 4
    frequency, pairs = doubled.frequency.numpy(), zip((doubled.values.real, doubled.values.imag), counted, strict=True)
    expected = [oracle.expected_level(part.numpy(), frequency, known, width=0.3) for part, known in pairs]
    assert doubled.level.reshape(2, -1).numpy() == pytest.approx(np.stack(expected), rel=5e-3)


def test_one_impact_tells_a_visible_shape_from_one_that_does_not_move_there():
    """At one contact all kernels explain a gain alike; a mode as loud as others is no shape that hardly moves there."""
    sites = impacts(1, seed=4)
    given, gains = Elastic(sites, SIZE, plate()), measured(sites, noise=0.0)
    gains.values[:] = 1.0 + 0.3j
    # The least remainder, which moves everywhere.
    seen = torch.where(given.shares[:, -1] == RESIDUALS[0], given.visibility(), torch.nan)
    typical, hidden = (int((seen - each).abs().nan_to_num(torch.inf).argmin()) for each in (1.0, 0.0))
    evidence = WeighedFamily.of(given, gains).evidence[:, 0]
    plain = log_evidence(given.kernels(), series_of(gains.values), gains.floor)[:, 0]
    assert torch.allclose(plain, plain[:1].expand_as(plain), atol=1e-9)
    assert bool((evidence[typical] > evidence[hidden] + 0.5).all())
