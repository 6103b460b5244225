"""Gains as Bayesian regression, against Gaussian processes written out in full."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from avmsf.field import foretelling, hypotheses
from avmsf.field.evidence import Regression
from avmsf.field.hypotheses import NOISES, REMAINDERS, UNHEARD, WIDTHS, Sites, nearness, row_of

ELASTIC = torch.tensor([100.0, 180, 240, 330, 460, 470, 610, 800], dtype=torch.float64)
HYPOTHESES = len(WIDTHS) * len(REMAINDERS) * len(NOISES)


def places(count: int, *, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def shapes_at(x: torch.Tensor) -> torch.Tensor:
    """Return a bar's first shapes, of mean square one."""
    return math.sqrt(2.0) * torch.cos(math.pi * torch.arange(1, 9, dtype=torch.float64) * x)


def smooth(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return torch.exp(-0.5 * (x - y.T).square() / 0.15**2)


def sites(x: torch.Tensor) -> Sites:
    return Sites(shapes_at(x), smooth(x, x))


def draw(x: torch.Tensor, frequency: torch.Tensor, hypothesis: tuple[int, int, int], *, seed: int = 0) -> torch.Tensor:
    """Return gains at places drawn from the prior of one hypothesis, noise included, of a size of each mode's own."""
    generator = torch.Generator().manual_seed(seed)
    width, remainder, noise = hypothesis
    prior = nearness(frequency, ELASTIC)[:, width]
    prior = prior / torch.einsum("ck,mk->m", shapes_at(x).square(), prior)[:, None] * len(x)
    part = REMAINDERS[remainder]
    drawn = []
    for mode in range(len(frequency)):
        field = (1 - part) * (shapes_at(x) * prior[mode]) @ shapes_at(x).T + part * smooth(x, x)
        half = torch.linalg.cholesky(field + 1e-9 * torch.eye(len(x)))
        own = torch.randn(len(x), 2, dtype=torch.float64, generator=generator) * NOISES[noise] ** 0.5
        clean = half @ torch.randn(len(x), 2, dtype=torch.float64, generator=generator)
        drawn.append(10.0 ** (mode % 3) * torch.stack([clean, clean + own]))
    return torch.stack(drawn, dim=2)


def weighed(
    known: Sites,
    frequency: torch.Tensor,
    values: torch.Tensor,
    floor: torch.Tensor | None = None,
    doubt: torch.Tensor | None = None,
) -> Regression:
    floor = values.new_zeros(values.shape[:2]) if floor is None else floor
    doubt = values.new_ones(len(values)) if doubt is None else doubt
    return Regression.of(known, nearness(frequency, ELASTIC), values, floor=floor, doubt=doubt)


def certain(regression: Regression, hypothesis: tuple[int, int, int]) -> Regression:
    """Return the regression that believes in one hypothesis alone."""
    weights = torch.zeros_like(regression.weights)
    width, remainder, noise = hypothesis
    weights[row_of(width, remainder, noise)] = 1.0
    return Regression(
        regression.sites, regression.prior, regression.values, regression.floor, regression.doubt, weights
    )


def evidence(regression: Regression) -> float:
    return float(
        Regression.evidence_of(
            regression.sites,
            regression.prior[None],
            regression.values,
            floor=regression.floor,
            doubt=regression.doubt,
        )[0]
    )


def some(modes: int = 6, contacts: int = 9) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x = places(contacts)
    frequency = torch.linspace(110, 700, modes, dtype=torch.float64)
    return x, frequency, draw(x, frequency, (2, 1, 2))[1]


def foretold(regression: Regression, x: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    weights, kernels = regression.expansion
    return torch.einsum("ck,kmd->cmd", shapes_at(at), weights) + torch.einsum("cs,smd->cmd", smooth(at, x), kernels)


def test_the_nearest_shape_is_drawn_upon_most_and_the_farthest_a_thousandth():
    near = nearness(torch.tensor([240.0], dtype=torch.float64), ELASTIC)
    assert near.shape == (1, len(WIDTHS), len(ELASTIC))
    assert near.argmax(2).tolist() == [[2] * len(WIDTHS)]
    assert float(near[0, 0, -1]) == pytest.approx(hypotheses.FARTHEST)
    # One width away in log frequency: exp(-1/2).
    away = nearness(ELASTIC[:1] * math.exp(WIDTHS[1]), ELASTIC[:1])
    assert float(away[0, 1, 0]) == pytest.approx(math.exp(-0.5) + hypotheses.FARTHEST)


@pytest.mark.parametrize("hypothesis", [(0, 0, 0), (2, 1, 3), (3, 2, 5)])
def test_one_hypothesis_is_a_gaussian_process(hypothesis: tuple[int, int, int]):
    x, frequency, values = some()
    floor = 0.05 * torch.rand(9, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    doubt = torch.ones(9, dtype=torch.float64)
    doubt[4] = 7.0
    regression = certain(weighed(sites(x), frequency, values, floor, doubt), hypothesis)
    at = places(5, seed=8)
    mean = foretold(regression, x, at)
    deviation = regression.deviation(shapes_at(at), smooth(at, x), at.new_ones(5))
    width, remainder, noise = hypothesis
    for mode in range(6):
        prior = np.exp(-0.5 * np.log(frequency[mode].numpy() / ELASTIC.numpy()) ** 2 / WIDTHS[width] ** 2) + 1e-3
        prior /= np.mean(shapes_at(x).numpy() ** 2 @ prior)

        def kernel(one: torch.Tensor, other: torch.Tensor, prior: np.ndarray = prior) -> np.ndarray:
            elastic = shapes_at(one).numpy() @ np.diag(prior) @ shapes_at(other).numpy().T
            return (1 - REMAINDERS[remainder]) * elastic + REMAINDERS[remainder] * smooth(one, other).numpy()

        own = NOISES[noise] * doubt.numpy() + floor[:, mode].numpy()
        covariance = kernel(x, x) + np.diag(own)
        inverse, known = np.linalg.inv(covariance), values[:, mode].numpy()
        assert mean[:, mode].numpy() == pytest.approx(kernel(at, x) @ inverse @ known, rel=1e-6, abs=1e-9)
        scale = np.einsum("cd,ce,ed->d", known, inverse, known) / 9
        variance = np.diag(kernel(at, at) - kernel(at, x) @ inverse @ kernel(x, at))
        assert deviation[:, mode].square().numpy() == pytest.approx(np.outer(variance, scale), rel=1e-6)
        assert regression.noise[:, mode].square().numpy() == pytest.approx(np.outer(own, scale), rel=1e-9)
        whole = regression.hypotheses.covariance(torch.tensor([mode]), torch.tensor([row_of(*hypothesis)]))
        assert whole[0, 0].numpy() == pytest.approx(covariance, rel=1e-9)


def test_evidence_is_the_normal_density_with_the_size_integrated_out():
    x, frequency, values = some(modes=2, contacts=5)
    regression = weighed(sites(x), frequency, values / values.square().mean((0, 2), keepdim=True).sqrt())
    found = regression.hypotheses.likelihood(torch.arange(2))
    direct = torch.empty_like(found)
    covariance = regression.hypotheses.covariance(torch.arange(2)).numpy()
    for hypothesis in range(0, HYPOTHESES, 13):
        for mode in range(2):
            for part in range(2):
                known = regression.values[:, mode, part].numpy()

                def density(log_size: float, known=known, each=covariance[hypothesis, mode]) -> float:
                    return multivariate_normal.pdf(known, cov=math.exp(2 * log_size) * each)

                direct[hypothesis, mode, part] = math.log(quad(density, -8, 8, points=(-1, 0, 1), limit=200)[0])
    apart = (found - direct)[::13]
    # One constant of the number of contacts for all: Gamma(n / 2) / 2 over pi^(n / 2).
    constant = math.log(0.5 * math.gamma(2.5) / math.pi**2.5)
    assert apart.numpy() == pytest.approx(np.full(apart.shape, -constant), abs=1e-5)


def test_weights_are_the_evidence_with_beliefs_that_modes_share():
    x, frequency, values = some()
    regression = weighed(sites(x), frequency, values)
    assert torch.allclose(regression.weights.sum(0), torch.ones(6, 2, dtype=torch.float64))
    single = regression.hypotheses.likelihood(torch.arange(6)).numpy()
    before = np.full((HYPOTHESES, 2), 1 / HYPOTHESES)
    for _ in range(5):
        after = np.exp(single - single.max(0)) * before[:, None]
        counts = (after / after.sum(0)).sum(1) + 0.1 * 6 / HYPOTHESES
        before = counts / counts.sum(0)
    joint = single + np.log(before)[:, None]
    top = joint.max(0)
    assert evidence(regression) == pytest.approx(float((top + np.log(np.exp(joint - top).sum(0))).sum()), rel=1e-9)


def test_modes_without_gains_have_no_say():
    x, frequency, values = some()
    quiet = torch.cat([values, torch.zeros_like(values[:, :2])], dim=1)
    more = torch.cat([frequency, frequency[:2] * 1.1])
    apart = [evidence(weighed(sites(x), frequency * each, values)) for each in (0.5, 2.0)]
    with_silence = [evidence(weighed(sites(x), more * each, quiet)) for each in (0.5, 2.0)]
    assert with_silence[1] - with_silence[0] == pytest.approx(apart[1] - apart[0], rel=0.05)
    regression = weighed(sites(x), more, quiet)
    assert regression.silent[6:].all()
    assert not regression.silent[:6].any()
    assert float(regression.expansion[0][:, 6:].abs().max()) == 0.0


def test_trying_priors_at_once_finds_the_evidence_of_each(monkeypatch: pytest.MonkeyPatch):
    x, frequency, values = some()
    floor, doubt = 0.02 * torch.ones(9, 6, dtype=torch.float64), torch.linspace(1, 3, 9, dtype=torch.float64)
    priors = torch.stack([nearness(frequency, factor * ELASTIC) for factor in (0.7, 1.0, 1.3)])
    alone = [evidence(Regression.of(sites(x), prior, values, floor=floor, doubt=doubt)) for prior in priors]
    # Batches that end amid a trial.
    monkeypatch.setattr(hypotheses, "MEMORY", 5 * HYPOTHESES * 81)
    together = Regression.evidence_of(sites(x), priors, values, floor=floor, doubt=doubt)
    assert together.tolist() == pytest.approx(alone, rel=1e-10)
    assert max(alone) - min(alone) > 1


def test_expansion_smoother_and_deviation_agree_at_the_contacts():
    x, frequency, values = some()
    regression = weighed(sites(x), frequency, values)
    smoothed = torch.einsum("mdce,emd->cmd", regression.smoother, values)
    expanded = foretold(regression, x, x)
    assert float((smoothed - expanded).abs().max()) < 1e-8 * float(values.abs().max())
    # What is struck is known better than what is not.
    known = regression.deviation(regression.sites.shapes, regression.sites.remainder, x.new_ones(9))
    afar = places(20, seed=9)
    assert bool((known.mean(0) < regression.deviation(shapes_at(afar), smooth(afar, x), x.new_ones(20)).mean(0)).all())


def test_gains_drawn_from_the_prior_are_foretold_and_their_doubt_is_true():
    """Over 60 modes 90 % intervals hold 90 % of what was left out, give or take what chance and learning leave."""
    x, frequency = places(40, seed=4), torch.linspace(90, 850, 60, dtype=torch.float64)
    clean, noisy = draw(x, frequency, (1, 1, 2), seed=5)
    train, held = torch.arange(12), torch.arange(12, 40)
    regression = weighed(sites(x[train]), frequency, noisy[train])
    error = foretold(regression, x[train], x[held]) - clean[held]
    size = clean[held].square().mean((0, 2), keepdim=True)
    assert float((error.square() / size).mean()) < 0.35
    doubt = regression.deviation(shapes_at(x[held]), smooth(x[held], x[train]), x.new_ones(len(held)))
    inside = float((error.abs() < 1.645 * doubt).double().mean())
    assert 0.85 < inside < 0.94


def test_a_mode_of_few_contacts_borrows_from_the_others_how_much_noise_there_is():
    x, frequency = places(6, seed=6), torch.linspace(100, 800, 40, dtype=torch.float64)
    noises = {}
    for noise in (0, 5):
        values = draw(x, frequency, (2, 0, noise), seed=7)[1]
        both = weighed(sites(x), frequency, values)
        named = torch.arange(HYPOTHESES) % len(NOISES)
        size = torch.log(torch.tensor(NOISES, dtype=torch.float64))[named]
        alone = [weighed(sites(x), frequency[row : row + 1], values[:, row : row + 1]) for row in range(40)]
        spread = torch.cat([torch.einsum("hmd,h->md", each.weights, size) for each in alone])
        shared = torch.einsum("hmd,h->md", both.weights, size)
        truth = math.log(NOISES[noise])
        assert float((shared - truth).square().mean()) < 0.7 * float((spread - truth).square().mean())
        noises[noise] = float(shared.mean())
    assert noises[5] > noises[0] + 1


def test_a_doubted_contact_counts_for_nothing():
    x, frequency, values = some()
    doubt = torch.ones(9, dtype=torch.float64)
    doubt[3] = UNHEARD
    wild = values.clone()
    wild[3] *= -1
    regressions = [weighed(sites(x), frequency, each, doubt=doubt) for each in (values, wild)]
    at = places(7, seed=9)
    one, other = (foretold(each, x, at) for each in regressions)
    assert float((one - other).abs().max()) < 1e-3 * float(values.abs().max())
    trusting = foretold(weighed(sites(x), frequency, wild), x, at)
    assert float((one - trusting).abs().max()) > 0.05 * float(values.abs().max())


def test_contacts_that_say_nothing_are_as_good_as_gone():
    x, frequency = places(16), torch.linspace(110, 700, 12, dtype=torch.float64)
    values = draw(x, frequency, (2, 1, 3))[1]
    wrong = torch.tensor([2, 7, 11])
    values[wrong] = values[wrong.roll(1)]
    doubt = torch.ones(16, dtype=torch.float64)
    doubt[wrong] = UNHEARD
    kept = doubt < UNHEARD
    doubted, removed = (
        weighed(sites(x), frequency, values, doubt=doubt),
        weighed(sites(x[kept]), frequency, values[kept]),
    )
    at = places(9, seed=9)
    expected = foretold(removed, x[kept], at)
    assert torch.allclose(foretold(doubted, x, at), expected, atol=1e-3 * float(expected.abs().max()))
    assert torch.allclose(doubted.weights, removed.weights, atol=1e-3)
    assert torch.allclose(doubted.noise[kept], removed.noise, rtol=1e-3)
    for mine, others in zip(doubted.left_out, removed.left_out, strict=True):
        assert torch.allclose(mine[kept], others, atol=1e-3 * float(others.abs().max()))
    deviations = [
        each.deviation(shapes_at(at), smooth(at, known), torch.ones(9, dtype=torch.float64))
        for each, known in ((doubted, x), (removed, x[kept]))
    ]
    assert torch.allclose(*deviations, rtol=1e-3)


def test_the_unit_of_gains_the_signs_of_shapes_and_the_order_of_contacts_do_not_matter():
    x, frequency, values = some()
    at = places(7, seed=9)
    expected = foretold(weighed(sites(x), frequency, values), x, at)
    loud = foretold(weighed(sites(x), frequency, 1e-4 * values), x, at)
    assert torch.allclose(1e4 * loud, expected, rtol=1e-9, atol=1e-9)
    order = torch.randperm(9, generator=torch.Generator().manual_seed(1))
    known = sites(x)
    moved = Sites(known.shapes[order], known.remainder[order][:, order])
    shuffled = weighed(moved, frequency, values[order])
    assert torch.allclose(foretold(shuffled, x[order], at), expected, rtol=1e-7, atol=1e-9)
    signs = torch.tensor([1.0, -1, -1, 1, -1, 1, 1, -1], dtype=torch.float64)
    turned = weighed(Sites(shapes_at(x) * signs, smooth(x, x)), frequency, values)
    weights, kernels = turned.expansion
    found = torch.einsum("ck,kmd->cmd", shapes_at(at) * signs, weights)
    assert torch.allclose(found + torch.einsum("cs,smd->cmd", smooth(at, x), kernels), expected, rtol=1e-7, atol=1e-9)


def test_degenerate_shapes_may_be_mixed_without_effect():
    x, frequency, values = some()
    pair = ELASTIC.clone()
    pair[5] = pair[4]
    turn = torch.eye(8, dtype=torch.float64)
    turn[4:6, 4:6] = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    known = [Sites(shapes_at(x) @ each, smooth(x, x)) for each in (torch.eye(8, dtype=torch.float64), turn)]
    floor, doubt = torch.zeros(9, 6, dtype=torch.float64), torch.ones(9, dtype=torch.float64)
    one, other = (Regression.of(each, nearness(frequency, pair), values, floor=floor, doubt=doubt) for each in known)
    assert torch.allclose(one.smoother, other.smoother, atol=1e-9)
    assert evidence(one) == pytest.approx(evidence(other), rel=1e-10)


def test_modes_may_be_taken_and_put_in_another_order():
    x, frequency, values = some()
    regression = weighed(sites(x), frequency, values)
    rows = torch.tensor([4, 0, 2])
    taken = regression.take(rows)
    at = places(7, seed=9)
    assert torch.allclose(foretold(taken, x, at), foretold(regression, x, at)[:, rows])
    doubled = regression.with_values(2 * values)
    assert torch.allclose(foretold(doubled, x, at), 2 * foretold(regression, x, at))


def test_many_places_are_doubted_a_batch_at_a_time(monkeypatch: pytest.MonkeyPatch):
    x, frequency, values = some()
    regression, at = weighed(sites(x), frequency, values), places(100, seed=2)
    asked = shapes_at(at), smooth(at, x), at.new_ones(100)
    whole = regression.deviation(*asked)
    sizes = []
    solve = torch.linalg.solve_triangular

    def counted(factor: torch.Tensor, cross: torch.Tensor, *, upper: bool) -> torch.Tensor:
        sizes.append(cross.numel())
        return solve(factor, cross, upper=upper)

    monkeypatch.setattr(torch.linalg, "solve_triangular", counted)
    monkeypatch.setattr(foretelling, "MEMORY", 2000)
    assert torch.allclose(regression.deviation(*asked), whole, rtol=1e-9, atol=0)
    assert max(sizes) <= 2000
