"""Closed forms against explicit sums; fits and refinement against sounds whose modes are known."""

import math
import warnings

import pytest
import torch
from torch import Tensor

from avmsf.modal.extraction.least_squares import NormalEquations, fit_gains, fit_sine_gains, refine
from avmsf.modal.inner_products import gram, poles_of, project
from avmsf.modal.modes import ModalBank, common_phase, synthesize

RATE = 8000.0


def bank_of(frequency: list[float], damping: list[float]) -> ModalBank:
    return ModalBank(torch.tensor(frequency, dtype=torch.float64), torch.tensor(damping, dtype=torch.float64))


# The first two lie closer than the sound resolves; the third is gone after a twentieth of it; the last hardly decays.
BANK = bank_of([440.0, 441.5, 1000.0, 2500.0, 3999.0], [3.0, 4.0, 600.0, 20.0, 1e-6])


def basis(bank: ModalBank, samples: int) -> Tensor:
    """Return all sines and then all cosines, [two_modes, samples]."""
    times = torch.arange(samples, dtype=torch.float64) / RATE
    decay = torch.exp(-bank.damping[:, None] * times)
    phase = 2 * math.pi * bank.frequency[:, None] * times
    return torch.cat([decay * torch.sin(phase), decay * torch.cos(phase)])


def draw(bank: ModalBank):
    """Return complex gains and the sounds they make."""
    generator = torch.Generator().manual_seed(3)
    gains = torch.complex(*torch.randn(2, 3, len(bank), generator=generator, dtype=torch.float64))
    return gains, torch.cat([gains.real, gains.imag], dim=1) @ basis(bank, 6000)


@pytest.mark.parametrize("power", [0, 1, 2])
@pytest.mark.parametrize("samples", [1, 37, 6000])
def test_gram_is_the_sum_over_time(power: int, samples: int):
    atoms = basis(BANK, samples)
    weights = torch.arange(samples, dtype=torch.float64) ** power
    expected = (atoms * weights) @ atoms.T
    found = gram(poles_of(BANK, RATE), samples, power=power)
    # Digits are lost in proportion to samples x 1e-16 where two modes are close, and the sums grow as samples^power.
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10 * max(1.0, float(expected.abs().max())))


@pytest.mark.parametrize("samples", [100, 512, 6000])
def test_projections_are_the_sums_over_time(samples: int):
    sounds = torch.randn(2, samples, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    atoms, steps = basis(BANK, samples), torch.arange(samples, dtype=torch.float64)
    plain, weighted = project(sounds, poles_of(BANK, RATE), weighted=True)
    assert weighted is not None
    # An atom is dropped below 1e-12 of its start.
    torch.testing.assert_close(plain, sounds @ atoms.T, rtol=1e-9, atol=1e-8)
    torch.testing.assert_close(weighted, sounds @ (steps * atoms).T, rtol=1e-9, atol=1e-8 * samples)


def test_gains_of_exact_sounds_come_back():
    gains, sounds = draw(BANK)
    # The close pair is conditioned about 1e3; the ridge of 1e-13 and rounding remain.
    torch.testing.assert_close(fit_gains(sounds, BANK, sample_rate=RATE), gains, rtol=0, atol=1e-7)
    assert fit_gains(sounds.float(), BANK, sample_rate=RATE).dtype == torch.complex64


def test_gains_of_sines_that_start_late_come_back_with_their_phases():
    gains = draw(BANK)[0].real
    phase = torch.linspace(-1.5, 1.5, len(BANK), dtype=torch.float64)
    sines, cosines = basis(BANK, 6000).chunk(2)
    sounds = gains @ (torch.cos(phase)[:, None] * sines + torch.sin(phase)[:, None] * cosines)
    found = fit_sine_gains(sounds, BANK, sample_rate=RATE, phase=phase)
    torch.testing.assert_close(found, gains, rtol=0, atol=1e-7)
    torch.testing.assert_close(common_phase(fit_gains(sounds, BANK, sample_rate=RATE)), phase, rtol=0, atol=1e-6)


def test_sine_gains_leave_the_least_residual():
    _, sounds = draw(BANK)
    atoms = basis(BANK, 6000)[: len(BANK)]
    best = torch.linalg.lstsq(atoms.T, sounds.T).solution.T
    torch.testing.assert_close(fit_sine_gains(sounds, BANK, sample_rate=RATE), best, rtol=0, atol=1e-7)


def test_two_modes_of_one_frequency_share_the_gain():
    twice = bank_of([700.0, 700.0], [5.0, 5.0])
    gains = fit_gains(basis(bank_of([700.0], [5.0]), 4000)[:1], twice, sample_rate=RATE)
    assert torch.isfinite(gains).all()
    assert complex(gains.sum()) == pytest.approx(1.0, abs=1e-6)


def test_refinement_finds_the_modes_from_nearby():
    truth = bank_of([440.0, 443.0, 1000.0, 2500.0], [3.0, 4.0, 60.0, 20.0])
    _, sounds = draw(truth)
    offsets, factors = torch.tensor([[0.3, -0.3, 4.0, 1.0], [1.5, 0.7, 1.4, 0.6]], dtype=torch.float64)
    start = ModalBank(truth.frequency + offsets, truth.damping * factors)
    found = refine(sounds, start, sample_rate=RATE, iterations=60)
    # The search ends when a step gains less than 1e-7 of the energy: the error is the root of that, shrunk once more.
    torch.testing.assert_close(found.frequency, truth.frequency, rtol=0, atol=1e-3)
    torch.testing.assert_close(found.damping, truth.damping, rtol=1e-3, atol=0)


@pytest.mark.parametrize("seed", range(4))
def test_refinement_never_explains_less(seed: int):
    generator = torch.Generator().manual_seed(seed)
    sounds = torch.randn(2, 1500, generator=generator) * torch.exp(-torch.arange(1500) / 400.0)
    frequency = torch.sort(4000 * torch.rand(8, generator=generator, dtype=torch.float64)).values
    bank = ModalBank(frequency, torch.exp(8 * torch.rand(8, generator=generator, dtype=torch.float64) - 2))
    banks = [bank] + [refine(sounds, bank, sample_rate=RATE, iterations=count) for count in range(1, 15)]
    explained = [NormalEquations.of(sounds, poles_of(modes, RATE)).explained() for modes in banks]
    assert explained == sorted(explained)
    assert explained[-1] > explained[0]
    found = banks[-1]
    assert torch.isfinite(found.frequency).all()
    assert (found.damping > 0).all()
    assert (found.frequency.diff() >= 0).all()
    assert 0 < found.frequency[0] < found.frequency[-1] < RATE / 2


def test_refinement_of_a_steady_tone_ends_above_no_damping():
    sounds = torch.sin(2 * math.pi * 500.0 / RATE * torch.arange(4000, dtype=torch.float64))[None]
    found = refine(sounds, bank_of([500.2], [2.0]), sample_rate=RATE, iterations=200)
    assert float(found.damping) >= 0.01 * RATE / 4000 * (1 - 1e-12)
    assert float(found.frequency) == pytest.approx(500.0, abs=0.01)


def test_lost_energy_is_the_difference_of_two_fits():
    bank = bank_of([440.0, 446.0, 1000.0], [3.0, 4.0, 60.0])
    _, sounds = draw(bank)
    system = NormalEquations.of(sounds, poles_of(bank, RATE))
    lost, apart = system.lost_without()
    for mode in range(3):
        rest = torch.tensor([row for row in range(3) if row != mode])
        fewer = system.take(rest)
        difference = (system.solve() * system.products).sum(1) - (fewer.solve() * fewer.products).sum(1)
        torch.testing.assert_close(lost[:, mode], difference, rtol=1e-6, atol=1e-6)
    assert (apart > 0.5).all()


def test_a_mode_that_others_span_is_not_apart():
    bank = bank_of([440.0, 440.05, 1000.0], [30.0, 30.0, 60.0])
    _, apart = NormalEquations.of(torch.ones(1, 6000), poles_of(bank, RATE)).lost_without()
    assert (apart[:2] < 1e-3).all()
    assert apart[2] > 0.9


def test_modes_that_others_span_do_not_keep_the_rest_from_moving():
    bank = bank_of([301.0, 700.0], [5.0, 5.0])
    gains = torch.randn(4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=6000, sample_rate=RATE)
    crowd = bank_of([*(300.0 + 1e-3 * step for step in range(8)), 700.0], [5.0] * 9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = refine(sounds, crowd, sample_rate=RATE)
    before, after = (NormalEquations.of(sounds, poles_of(each, RATE)).explained() for each in (crowd, found))
    assert after > (1.0 + 1e-6) * before
