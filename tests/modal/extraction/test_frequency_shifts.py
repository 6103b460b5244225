"""Poles of a recording's own, against recordings whose poles are known."""

import math
from pathlib import Path

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.extract import extract_once, extract_sounds
from avmsf.modal.extraction.finders import HighResolution
from avmsf.modal.modes import ModalBank, synthesize

RATE, SAMPLES, CONTACTS = 16000.0, 16000, 8
FREQUENCY = torch.tensor([520.0, 1210.0, 2400.0, 2404.0, 3900.0], dtype=torch.float64)
"""Hz. The third and the fourth are a doublet, as of a nearly round object."""
NOISE = 1e-3
DAMPING = torch.tensor([4.0, 6.0, 8.0, 9.0, 20.0], dtype=torch.float64)


def draw(shift: float, *, alike: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return sounds, their gains and each recording's own frequencies."""
    generator = torch.Generator().manual_seed(5)
    gains = torch.complex(*torch.randn(2, CONTACTS, len(FREQUENCY), generator=generator, dtype=torch.float64))
    moves = shift * torch.randn(CONTACTS, 1 if alike else len(FREQUENCY), generator=generator, dtype=torch.float64)
    frequency = FREQUENCY * (1.0 + moves)
    sounds = synthesize(gains, frequency, DAMPING, samples=SAMPLES, sample_rate=RATE)
    sounds = sounds + NOISE * torch.randn(sounds.shape, generator=generator, dtype=torch.float64)
    return sounds, gains, frequency


@pytest.mark.parametrize("alike", [False, True], ids=["each mode", "all modes alike"])
def test_each_recording_has_the_frequencies_it_was_made_with(alike: bool):
    sounds, gains, frequency = draw(5e-4, alike=alike)
    found = extract_sounds(sounds, sample_rate=RATE)
    assert found.shifts is not None
    # One pole a mode, where common poles would need several.
    assert len(found.bank) == len(FREQUENCY)
    # By the Cramer-Rao bound of a damped sine in white noise, sqrt(8 d^3 / rate) noise / |c| / 2 pi.
    bound = (8 * DAMPING**3 / RATE).sqrt() * NOISE / gains.abs() / (2 * math.pi)
    error = (found.shifts.poles.imag / (2 * math.pi) - frequency).abs() / bound
    assert float(error.square().mean().sqrt()) < 3.0
    torch.testing.assert_close(found.gains, gains, rtol=0.0, atol=2e-3)
    # At common poles the sounds are those of the same gains, but for the noise.
    common = synthesize(gains, found.bank.frequency, found.bank.damping, samples=SAMPLES, sample_rate=RATE)
    assert float((sounds - common).square().mean().sqrt()) > 100 * NOISE
    assert float((found.at_common_poles(sounds, sample_rate=RATE) - common).square().mean().sqrt()) < 1.1 * NOISE


def test_shifts_are_kept_to_the_last_bit(tmp_path: Path):
    names = tuple(f"{row}.wav" for row in range(CONTACTS))
    train = Impacts(torch.zeros(CONTACTS, 3, dtype=torch.float64), draw(5e-4)[0], RATE, names)
    found, kept = (extract_once(train, HighResolution(), tmp_path / "modes.safetensors") for _ in range(2))
    assert kept.shifts.relative == found.shifts.relative
    assert torch.equal(kept.shifts.poles, found.shifts.poles)
    assert torch.equal(kept.gains, found.gains)


def test_the_same_sounds_shift_by_the_same_whatever_memory_held_before():
    sounds = draw(5e-4)[0]
    found = []
    for row in range(3):
        # Freed at once, so that what is allocated next holds it.
        [torch.full((count,), row, dtype=torch.int32) for count in range(1, 9)]
        found.append(HighResolution().find_shifts(sounds, ModalBank(FREQUENCY, DAMPING), RATE))
    assert all(torch.equal(found[0].poles, each.poles) for each in found[1:])


def test_a_doublet_that_all_recordings_share_does_not_shift():
    sounds, _, _ = draw(0.0)
    bank = HighResolution().find(sounds, RATE)
    assert len(bank) == len(FREQUENCY)
    assert HighResolution().find_shifts(sounds, bank, RATE) is None


def test_poles_that_move_along_damping_as_much_as_along_frequency_do_not_shift():
    """As poles do that stand for several unresolved modes."""
    generator = torch.Generator().manual_seed(7)
    draws = torch.randn(2, 2, CONTACTS, len(FREQUENCY), generator=generator, dtype=torch.float64)
    gains, moves = torch.complex(draws[0], draws[1])
    found = []
    for damping in (DAMPING, DAMPING + 0.2 * DAMPING * moves.real):
        frequency = FREQUENCY + 0.2 * DAMPING * moves.imag / (2 * math.pi)
        sounds = synthesize(gains, frequency, damping, samples=SAMPLES, sample_rate=RATE)
        sounds = sounds + NOISE * torch.randn(sounds.shape, generator=generator, dtype=torch.float64)
        found.append(HighResolution().find_shifts(sounds, ModalBank(FREQUENCY, DAMPING), RATE))
    assert found[0] is not None
    assert found[1] is None


def test_a_silent_recording_takes_no_modes_away():
    sounds = torch.cat([draw(5e-4)[0], torch.zeros(1, SAMPLES)])
    found = extract_sounds(sounds, sample_rate=RATE)
    assert found.shifts is not None
    assert len(found.bank) == len(FREQUENCY)
    # Rows may be any sequence.
    assert torch.equal(found.take((0, 2)).gains, found.gains[[0, 2]])
