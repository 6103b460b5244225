"""The mixture of Gaussian processes against textbook formulas with explicit matrices."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from avmsf.field.gains import mixture as module
from avmsf.field.gains.mixture import (
    LEVEL_DEVIATION,
    NOISE_SHARES,
    SCALE_SHAPE,
    Hypotheses,
    KernelMixture,
    log_evidence,
    mean_magnitude,
    posterior_weights,
)
from oracles import gain_model as oracle

CONTACTS, PLACES, KERNELS, SERIES = 7, 4, 4, 5
GROUPS = torch.tensor([0, 0, 1, 2, 1, 3, 1])


@cache
def posterior(
    given: Hypotheses, kernels: torch.Tensor, values: torch.Tensor, floor: torch.Tensor
) -> tuple[KernelMixture, torch.Tensor]:
    """Weigh hypotheses, their prior learned from all series that have any energy."""
    evidence = log_evidence(kernels, values, floor)
    weights = posterior_weights(evidence, given, values.any(0))
    kept = torch.nonzero(weights.sum((1, 2)) > 0).flatten()
    return KernelMixture(kernels[kept], values, floor, weights[kept]), kept


def joint_kernels() -> np.ndarray:
    """Return kernels among contacts and places: of full rank, of rank one, of rank three, and none at all."""
    generator = np.random.default_rng(1)
    found = []
    for rank in (CONTACTS + PLACES, 1, 3):
        factor = generator.normal(size=(CONTACTS + PLACES, rank))
        kernel = factor @ factor.T
        found.append(kernel / np.diag(kernel)[:CONTACTS].mean())
    return np.stack([*found, np.zeros_like(found[0])])


def among() -> np.ndarray:
    return joint_kernels()[:, :CONTACTS, :CONTACTS]


@cache
def drawn() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values, floors and the log prior of each kernel and noise share for each series."""
    generator = np.random.default_rng(2)
    values = generator.normal(size=(CONTACTS, SERIES)) * [1.0, 10.0, 0.1, 3.0, 1.0]
    # The first two series come from two of the kernels.
    for series, kernel in ((0, 0), (1, 2)):
        covariance = among()[kernel] + 0.01 * np.eye(CONTACTS)
        values[:, series] = np.linalg.cholesky(covariance) @ values[:, series]
    prior = generator.normal(size=(KERNELS, len(NOISE_SHARES), SERIES))
    return values, generator.uniform(0.0, 0.05, SERIES), prior


def textbook_weights(rows: list[int], series: int) -> np.ndarray:
    """Return the posterior of kernels and noise shares given some contacts' values."""
    values, floor, prior = drawn()
    kernels = among()[:, rows][:, :, rows]
    evidence = [
        [oracle.log_evidence(kernel, q + floor[series], values[rows, series]) for q in NOISE_SHARES]
        for kernel in kernels
    ]
    joint = np.array(evidence) + prior[..., series]
    weights = np.exp(joint - joint.max())
    return weights / weights.sum()


def textbook_prediction(rows: list[int], asked: list[int], series: int, *, noise: bool) -> oracle.Prediction:
    """Return what the values at the contacts `rows` predict at others or places; `noise` as in the oracle."""
    values, floor, _ = drawn()
    both = [*rows, *asked]
    kernels = joint_kernels()[:, both][:, :, both].repeat(len(NOISE_SHARES), axis=0)
    variances = [share + floor[series] for share in NOISE_SHARES] * KERNELS
    return oracle.averaged(
        kernels, variances, textbook_weights(rows, series).flatten(), values[rows, series], noise=noise
    )


@cache
def mixture() -> KernelMixture:
    values, floor, _ = drawn()
    weights = np.stack([textbook_weights(list(range(CONTACTS)), series) for series in range(SERIES)], axis=2)
    return KernelMixture(*(torch.from_numpy(each.copy()) for each in (among(), values, floor, weights)))


def hypotheses(**changes) -> Hypotheses:
    log_prior = torch.from_numpy(drawn()[2][:, 0].copy())
    prior = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    return replace(Hypotheses(torch.tensor([0, 1, 1, 2]), prior, log_prior), **changes)


def test_evidence_is_the_textbook_one():
    values, floor, _ = drawn()
    found = log_evidence(*(torch.from_numpy(each.copy()) for each in (among(), values, floor)))
    expected = [
        [[oracle.log_evidence(k, q + floor[s], values[:, s]) for s in range(SERIES)] for q in NOISE_SHARES]
        for k in among()
    ]
    assert found.numpy() == pytest.approx(np.array(expected), rel=1e-9)


def test_evidence_does_not_depend_on_the_batches(monkeypatch):
    tensors = [torch.from_numpy(each.copy()) for each in (among(), *drawn()[:2])]
    whole = log_evidence(*tensors)
    monkeypatch.setattr(module, "_MEMORY", 1)
    assert torch.allclose(log_evidence(*tensors), whole, rtol=1e-12, atol=0.0)


def test_mean_spread_and_magnitude_are_those_of_the_hypotheses():
    """The magnitude with their deviations, by draws, and without."""
    joint = torch.from_numpy(joint_kernels().copy())
    cross, own = joint[:, CONTACTS:, :CONTACTS], torch.diagonal(joint, dim1=1, dim2=2)[:, CONTACTS:]
    taken = (lambda m, _: m, lambda m, variance: m.square() + variance, mean_magnitude, lambda m, _: m.abs())
    mean, square, magnitude, of_means = mixture().average(cross, own, *taken)
    spread = (square - mean.square()).sqrt()
    places = list(range(CONTACTS, CONTACTS + PLACES))
    for series in range(SERIES):
        expected = textbook_prediction(list(range(CONTACTS)), places, series, noise=False)
        assert mean[:, series].numpy() == pytest.approx(expected.mean, rel=1e-8, abs=1e-10)
        assert spread[:, series].numpy() == pytest.approx(expected.deviation, rel=1e-6)
        assert magnitude[:, series].numpy() == pytest.approx(expected.magnitude, rel=1e-4, abs=1e-12)
        assert of_means[:, series].numpy() == pytest.approx(expected.of_means, rel=1e-4, abs=1e-12)


def test_the_prior_of_the_scale_is_integrated_over():
    """The evidence of one kernel over another is the ratio of integrals over s^2, here by quadrature."""
    values, floor, _ = drawn()
    few = values[:2]
    expected = np.array([[0.3, 2.0, 0.01][row % 3] * np.ones(SERIES) for row in range(KERNELS)])
    kernels = among()[:, :2, :2]
    found = log_evidence(
        *(torch.from_numpy(each.copy()) for each in (kernels, few, floor)), expected=torch.from_numpy(expected)
    )
    integrals = np.empty((KERNELS, SERIES))
    for row, series in np.ndindex(KERNELS, SERIES):
        scale = SCALE_SHAPE * expected[row, series]
        integrals[row, series] = oracle.integrated_log_evidence(
            kernels[row], NOISE_SHARES[1] + floor[series], few[:, series],
            # Inverse gamma of s^2 in log s^2, without what is common to all kernels.
            lambda logs, scale=scale: SCALE_SHAPE * np.log(scale) - SCALE_SHAPE * logs - scale * np.exp(-logs),
            (-25.0, 25.0),
        )  # fmt: skip
    difference = found[:, 1].numpy() - integrals
    assert difference == pytest.approx(np.tile(difference[:1], (KERNELS, 1)), abs=1e-6)


def test_levels_maximize_the_textbook_posterior():
    values, floor, _ = drawn()
    counted = [0, 1, 4]

    def cost(logs: np.ndarray) -> float:
        total = 0.5 * float(np.square(logs / LEVEL_DEVIATION).sum()) + len(counted) * logs.sum()
        for series in counted:
            terms = [
                np.log(float(weight))
                + oracle.log_evidence(kernel, q + floor[series], values[:, series] * np.exp(-logs))
                - oracle.log_evidence(kernel, q + floor[series], values[:, series])
                for kernel, row in zip(mixture().kernels.numpy(), mixture().weights[..., series], strict=True)
                for q, weight in zip(NOISE_SHARES, row, strict=True)
                if weight > 0
            ]
            total -= np.logaddexp.reduce(terms)
        return total

    expected = minimize(cost, np.zeros(CONTACTS)).x
    assert np.abs(expected).max() > 0.2
    assert mixture().take(torch.tensor(counted)).levels().log().numpy() == pytest.approx(expected, abs=1e-3)


def test_standard_error_is_the_root_of_the_mean_noise_variance():
    values, floor, _ = drawn()
    for series in range(SERIES):
        weights, total = textbook_weights(list(range(CONTACTS)), series), 0.0
        for row, column in np.ndindex(weights.shape):
            variance = NOISE_SHARES[column] + floor[series]
            total += weights[row, column] * variance * oracle.conditional(among()[row], variance, values[:, series])[2]
        assert float(mixture().standard_error()[series]) == pytest.approx(np.sqrt(total), rel=1e-8)


@pytest.mark.parametrize("groups", [torch.arange(CONTACTS), GROUPS])
def test_leave_out_is_what_the_other_groups_predict(groups):
    """By conditioning on the others alone: their evidence weighs the hypotheses, with the same prior."""
    found = mixture().leave_out(groups)
    for group in torch.unique(groups):
        rows = torch.nonzero(groups == group).flatten().tolist()
        others = torch.nonzero(groups != group).flatten().tolist()
        for series in range(SERIES):
            expected = textbook_prediction(others, rows, series, noise=True)
            for one, other, rel in zip(found, expected, (1e-6, 1e-6, 1e-6, 1e-3), strict=True):
                assert one[rows, series].numpy() == pytest.approx(other, rel=rel, abs=1e-9)


def test_a_lone_group_is_predicted_as_silence():
    mean = mixture().leave_out(torch.zeros(CONTACTS, dtype=torch.int64)).mean
    assert torch.allclose(mean, torch.zeros_like(mean), atol=1e-9)


def test_weights_sum_to_one_and_none_is_negligible():
    found, kept = posterior(hypotheses(), mixture().kernels, mixture().values, mixture().floor)
    assert torch.equal(found.kernels, mixture().kernels[kept])
    assert torch.allclose(found.weights.sum((0, 1)), torch.ones(SERIES, dtype=torch.float64))
    assert bool((found.weights >= 0.01 * found.weights.amax((0, 1)))[found.weights > 0].all())
    assert bool((found.weights == 0).any())


def test_without_active_series_weights_are_bayes_theorem():
    likelihood = torch.from_numpy(np.random.default_rng(4).uniform(size=(KERNELS, len(NOISE_SHARES), SERIES)))
    given = hypotheses()
    found = posterior_weights(likelihood, given, torch.zeros(SERIES, dtype=torch.bool))
    prior = given.category_prior[given.category, None, None] / len(NOISE_SHARES) * given.log_prior[:, None].exp()
    joint = prior * likelihood.exp()
    assert torch.allclose(found, joint / joint.sum((0, 1)), rtol=1e-12)


def learned_prior(likelihood: torch.Tensor, given: Hypotheses) -> torch.Tensor:
    """Return the prior [categories, noises] that some series teach: the posterior of one more that says nothing."""
    silent = torch.zeros(*likelihood.shape[:2], 1, dtype=torch.float64)
    active = torch.arange(likelihood.shape[2] + 1) < likelihood.shape[2]
    log_prior = torch.cat([given.log_prior, silent[:, 0]], dim=1)
    both = posterior_weights(torch.cat([likelihood, silent], dim=2), replace(given, log_prior=log_prior), active)
    counts = torch.bincount(given.category).double()[given.category, None]
    total = torch.zeros(len(given.category_prior), likelihood.shape[1], dtype=torch.float64)
    # Each of a category's kernels has the category's probability: the posterior of silence divides by their number.
    total.index_add_(0, given.category, both[..., -1] / counts)
    return total / total.sum()


def test_the_prior_is_learned_by_five_rounds_of_expectation_maximization():
    """With a pseudo-count of a tenth of a series each."""
    likelihood = np.random.default_rng(3).normal(size=(KERNELS, len(NOISE_SHARES), 30))
    likelihood[0] += 2.0
    log_prior = np.random.default_rng(4).normal(size=(KERNELS, 30))
    given = hypotheses(log_prior=torch.from_numpy(log_prior))
    start = np.tile(given.category_prior.numpy()[:, None] / len(NOISE_SHARES), (1, len(NOISE_SHARES)))
    expected = oracle.learned_prior(
        likelihood + log_prior[:, None], given.category.tolist(), start, rounds=5, pseudo_count=0.1
    )
    assert learned_prior(torch.from_numpy(likelihood), given).numpy() == pytest.approx(expected, rel=1e-6)


def test_thousands_of_equally_probable_kernels_keep_their_weights():
    kernels = torch.eye(2, dtype=torch.float64).expand(3000, -1, -1)
    category, prior = torch.zeros(3000, dtype=torch.int64), torch.ones(1, dtype=torch.float64)
    given = Hypotheses(category, prior, torch.zeros(3000, 1, dtype=torch.float64))
    values = torch.tensor([[1.0], [-0.5]], dtype=torch.float64)
    found, kept = posterior(given, kernels, values, torch.zeros(1, dtype=torch.float64))
    assert len(kept) == 3000
    assert float(found.weights.sum()) == pytest.approx(1.0)
