"""The one delay between recordings of a simulated object and its truth, and figures that do not depend on it."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.evaluation.modal_metrics import common_delay, compare_modes, truth_from_first_sample
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.simulation import recorded

RATE, COUNT = 8000.0, 10
FREQUENCY = torch.tensor([310.0, 742.0, 880.0, 1630.0, 2900.0], dtype=torch.float64)
DAMPING = torch.tensor([60.0, 90.0, 70.0, 200.0, 400.0], dtype=torch.float64)


def known(modes: int = 5) -> Truth:
    gains = torch.complex(*torch.randn(2, COUNT, modes, generator=torch.Generator().manual_seed(0)).double())
    names = tuple(f"{row}.wav" for row in range(COUNT))
    starts = torch.zeros(COUNT, dtype=torch.float64)
    return Truth(FREQUENCY[:modes], DAMPING[:modes], gains, names, starts=starts)


def heard(truth: Truth, starts: torch.Tensor, *, noise: float = 0.0) -> Impacts:
    """Return recordings whose sounds start at these samples, which may be negative."""
    poles = torch.complex(-truth.damping, 2 * math.pi * truth.frequency)
    sounds = recorded(poles, truth.amplitudes, starts, sample_rate=RATE, samples=2000)
    noises = torch.randn(sounds.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sounds = sounds + noise * sounds.square().mean().sqrt() * noises
    return Impacts(torch.zeros(COUNT, 3, dtype=torch.float64), sounds.float(), RATE, truth.names)


@pytest.mark.parametrize("modes", [1, 5])
@pytest.mark.parametrize("samples", [0.0, 2.3, -3.7, 30.4, -31.8])
def test_the_common_delay_is_recovered_to_a_fraction_of_a_sample(samples: float, modes: int) -> None:
    truth = known(modes)
    impacts = heard(truth, torch.full((COUNT,), -samples, dtype=torch.float64), noise=0.03)
    assert common_delay(truth, impacts) * RATE == pytest.approx(samples, abs=0.05)


def test_of_unequal_delays_it_is_the_one_that_serves_all_best() -> None:
    starts = torch.randn(COUNT, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 5.0
    # Starts spread by one sample: their mean is uncertain by a third of one.
    assert common_delay(known(), heard(known(), starts)) * RATE == pytest.approx(-float(starts.mean()), abs=0.7)


@dataclass(frozen=True, eq=False)
class Fitted:
    """Amplitudes by least squares of the recordings themselves, too loud by a tenth."""

    impacts: Impacts
    bank: ModalBank

    def complex_gains(self, contacts: torch.Tensor, *, directions: torch.Tensor | None = None) -> torch.Tensor:
        return -1.1j * fit_gains(self.impacts.sounds, self.bank, sample_rate=RATE)


def figures(truth: Truth, samples: float) -> dict[str, float | None]:
    impacts = heard(truth, torch.full((COUNT,), -samples, dtype=torch.float64))
    moved = truth_from_first_sample(truth, impacts)
    return compare_modes(Fitted(impacts, ModalBank(FREQUENCY, DAMPING)), impacts.contacts, moved).figures()


@pytest.mark.parametrize("samples", [2.3, 40.0])
def test_a_delay_of_all_recordings_changes_no_figure(samples: float) -> None:
    usual, shifted = figures(known(), 0.0), figures(known(), samples)
    assert usual["gain_error"] == pytest.approx(0.1, abs=1e-3)
    assert shifted["gain_error"] == pytest.approx(usual["gain_error"], abs=1e-3)
    assert shifted["mac"] == pytest.approx(usual["mac"], abs=1e-3)


def test_a_truth_whose_files_start_with_their_impacts_stays_as_it_is() -> None:
    truth = replace(known(), starts=None)
    impacts = heard(truth, torch.full((COUNT,), -2.0, dtype=torch.float64))
    assert truth_from_first_sample(truth, impacts) is truth
