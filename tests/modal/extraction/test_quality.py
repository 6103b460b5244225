"""Quality of modes on sums of known damped sines, where every figure has a closed form or a known answer."""

import math
import warnings
from pathlib import Path

import pytest
import torch
from torch import Tensor

from avmsf.capture import CaptureSettings, read_capture
from avmsf.errors import CaptureWarning
from avmsf.modal.extraction.esprit import stable_orders
from avmsf.modal.extraction.extract import Extraction, extract_modes, extract_sounds
from avmsf.modal.extraction.finders import HighResolution
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.extraction.quality import ModeQuality, measure_quality
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual
from oracles.known_modes import AIRCRAFT, count_modes, tree_frequencies

RATE = 8000.0
SAMPLES = 8000
LEVEL = 0.01
"""Standard deviation of the noise; amplitudes are about one."""


def bank_of(*poles: tuple[float, float]) -> ModalBank:
    return ModalBank(*torch.tensor(poles, dtype=torch.float64).T)


TRUTH = bank_of((400.0, 8.0), (700.0, 15.0), (1500.0, 30.0))


def record(bank: ModalBank, gains: Tensor, *, noise: float = LEVEL, seed: int = 0) -> Tensor:
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=SAMPLES, sample_rate=RATE)
    return sounds + noise * torch.randn(sounds.shape, generator=seeded(seed), dtype=torch.float64)


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def shapes(contacts: int, modes: int, seed: int = 3) -> Tensor:
    return torch.randn(contacts, modes, generator=seeded(seed), dtype=torch.float64)


def fitted(sounds: Tensor, bank: ModalBank) -> Extraction:
    return Extraction(bank, fit_gains(sounds, bank, sample_rate=RATE), Residual(torch.zeros(5)))


def quality_of(sounds: Tensor, bank: ModalBank) -> ModeQuality:
    return measure_quality(sounds, fitted(sounds, bank), sample_rate=RATE)


def wandering(spread: float, *, contacts: int = 24) -> Tensor:
    """Return recordings of one mode of about 700 Hz whose frequency differs between them, and of two others."""
    gains = shapes(contacts, 3)
    sounds = record(TRUTH, gains * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))
    for row, offset in enumerate(spread * torch.randn(contacts, generator=seeded(5), dtype=torch.float64)):
        own = ModalBank(TRUTH.frequency[1:2] + offset, TRUTH.damping[1:2])
        sounds[row] += record(own, gains[row : row + 1, 1:2], noise=0.0)[0]
    return sounds


def test_what_falls_within_a_period_is_no_mode_however_much_it_explains() -> None:
    bank = ModalBank(TRUTH.frequency[:2], torch.stack([TRUTH.damping[0], 1.1 * TRUTH.frequency[1]]))
    assert quality_of(record(bank, shapes(8, 3)[:, :2]), bank).is_mode.tolist() == [True, False]


@pytest.mark.parametrize("contacts", [4, 20])
def test_known_sines_in_noise_are_modes_and_nothing_else_is_found(contacts: int) -> None:
    sounds = record(TRUTH, shapes(contacts, 3))
    found = extract_sounds(sounds, sample_rate=RATE)
    assert len(found.bank) == 3
    quality = measure_quality(sounds, found, sample_rate=RATE)
    assert quality.is_mode.all()
    assert float(quality.coherence.min()) > 0.99
    # Noise of a hundredth of the amplitude: a recording's own pole explains hardly more than the others' pole.
    assert float(quality.explained_left_out.min()) > 0.99
    assert float(stable_orders(sounds, found.bank, sample_rate=RATE).min()) > 0.8


def test_spreads_over_recordings_are_the_cramer_rao_bound() -> None:
    contacts = 200
    bank = bank_of((700.0, 15.0))
    quality = quality_of(record(bank, torch.ones(contacts, 1, dtype=torch.float64)), bank)
    # Of a d exp(-d t) of complex amplitude one with its phase and amplitude unknown, the information about the pole is
    # rate / (4 s^2) times the integral of t^2 e^(-2dt) less what the amplitude takes: 1 / (8 d^3).
    bound = math.sqrt(LEVEL**2 / (RATE / 2) * 8 * 15.0**3)
    # Two hundred recordings: a standard deviation is known to 5 %; four times that.
    assert float(quality.damping_spread[0]) == pytest.approx(bound, rel=0.2)
    assert float(quality.frequency_spread[0]) == pytest.approx(bound / (2 * math.pi), rel=0.2)


def test_a_frequency_that_differs_between_recordings_shows_in_its_spread_alone() -> None:
    quality = quality_of(wandering(0.5), TRUTH)
    assert float(quality.frequency_spread[1]) == pytest.approx(0.5, rel=0.35)
    assert float(quality.frequency_spread[[0, 2]].max()) < 0.05


def test_a_second_pole_for_a_wandering_frequency_is_no_mode() -> None:
    sounds = wandering(1.0)
    found = fitted(sounds, HighResolution().find(sounds, RATE))
    near = (found.bank.frequency - 700.0).abs() < 15.0
    assert int(near.sum()) > 1
    quality = measure_quality(sounds, found, sample_rate=RATE)
    assert int((near & quality.is_mode).sum()) == 1
    assert int((~near & quality.is_mode).sum()) == 2


def test_a_split_pole_is_one_mode_and_a_doublet_two() -> None:
    pair = bank_of((700.0, 15.0), (702.5, 16.0))
    gains = shapes(16, 2)
    doublet = quality_of(record(pair, gains), pair)
    assert doublet.is_mode.tolist() == [True, True]
    # The same poles, one amplitude a fixed part of the other's: a decay that is not exponential.
    split = quality_of(record(pair, gains[:, :1] * torch.tensor([1.0, 0.4], dtype=torch.float64)), pair)
    assert split.is_mode.tolist() == [True, False]


def test_a_pole_that_is_fitted_to_a_strong_modes_remains_is_no_mode() -> None:
    # Each recording's burst has a pole of its own near 1000 Hz: what they share is not a mode of the object.
    contacts = 24
    sounds = record(TRUTH, shapes(contacts, 3))
    offsets = 40.0 * torch.randn(contacts, generator=seeded(6), dtype=torch.float64)
    for row, offset in enumerate(offsets):
        own = ModalBank(1000.0 + offset[None], torch.tensor([60.0], dtype=torch.float64))
        sounds[row] += record(own, torch.full((1, 1), 0.3, dtype=torch.float64), noise=0.0)[0]
    quality = quality_of(sounds, bank_of((400.0, 8.0), (700.0, 15.0), (1000.0, 120.0), (1500.0, 30.0)))
    assert quality.is_mode.tolist() == [True, True, False, True]
    assert float(quality.explained_left_out[2]) < 0.7


def test_coherence_is_one_for_one_phase_modulo_pi_and_low_for_random_phases() -> None:
    bank = bank_of((700.0, 15.0))
    gains = shapes(64, 1)
    assert float(quality_of(record(bank, (1 - 0.7j) * gains), bank).coherence) > 0.999
    turned = torch.polar(torch.ones(64, 1), 2 * math.pi * torch.rand(64, 1, generator=seeded(8))).to(torch.complex128)
    sounds = synthesize(turned, bank.frequency, bank.damping, samples=SAMPLES, sample_rate=RATE)
    # Of 64 random phases the resultant is 1/8 in the root mean square.
    assert float(quality_of(sounds, bank).coherence) < 0.35


def test_a_pole_that_is_not_there_is_stable_at_no_order() -> None:
    sounds = record(TRUTH, shapes(4, 3))
    stable = stable_orders(sounds, bank_of((400.0, 8.0), (550.0, 10.0)), sample_rate=RATE)
    assert float(stable[0]) > 0.8
    assert float(stable[1]) < 0.2


@pytest.mark.slow
def test_all_known_modes_of_measured_objects_are_found_and_called_modes(shared: Path) -> None:
    for name, known in (("aircraft_response", AIRCRAFT), ("tree43", tree_frequencies(shared))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CaptureWarning)
            impacts = read_capture(shared / name, CaptureSettings()).impacts
        assert count_modes(impacts, extract_modes(impacts), known).found == len(known)
