"""Extraction against the closed-form plate, doublets, changes that must not matter, and bad input."""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import ExtractionError
from avmsf.modal.extraction.extract import Extraction, extract_modes, extract_once, extract_sounds
from avmsf.modal.extraction.finders import HighResolution, lowest_frequency
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import ModalBank, synthesize
from factories.raising import raises
from oracles.plate import Plate, PlateModes, plate_modes, strike

RATE = 16000.0
PLATE = Plate(alpha=20.0)
HIGHEST = 4000.0


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@cache
def recorded(noise_db: float, *, contacts: int = 6, seconds: float = 0.5) -> tuple[Impacts, PlateModes]:
    recorder = {"sample_rate": RATE, "seconds": seconds, "noise_db": noise_db}
    impacts = strike(PLATE, contacts, highest=HIGHEST, seed=1, **recorder)
    return impacts, plate_modes(PLATE, impacts.contacts, highest=HIGHEST)


@cache
def extracted(noise_db: float, seconds: float) -> Extraction:
    return extract_modes(recorded(noise_db, seconds=seconds)[0])


def matched(bank: ModalBank, truth: PlateModes) -> tuple[Tensor, Tensor, Tensor]:
    """Return for each true mode the nearest found one's relative errors of frequency and damping, and its energy."""
    nearest = (bank.frequency[:, None] - truth.frequency).abs().argmin(0)
    energy = (truth.gains.square() / (4 * truth.damping)).sum(0)
    frequency, damping = bank.frequency[nearest] / truth.frequency, bank.damping[nearest] / truth.damping
    return (frequency - 1).abs(), (damping - 1).abs(), energy


def impacts_of(sounds: Tensor, rate: float = RATE) -> Impacts:
    names = tuple(f"{row}.wav" for row in range(len(sounds)))
    return Impacts(contacts=torch.zeros(len(sounds), 3), sounds=sounds, sample_rate=rate, names=names)


def make(bank: ModalBank, gains: Tensor, *, rate: float, samples: int, noise: float, seed: int = 0) -> Tensor:
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=rate)
    return sounds + noise * torch.randn(sounds.shape, generator=seeded(seed))


@pytest.mark.parametrize("noise_db", [-20.0, -40.0])
def test_the_plates_modes_are_found(noise_db: float):
    truth, found = recorded(noise_db)[1], extracted(noise_db, 0.5)
    frequency, damping, energy = matched(found.bank, truth)
    strong = energy > energy.max() * 1e-4
    assert int(strong.sum()) >= 20
    assert float(frequency[strong].max()) < 5e-4
    assert float(damping[strong].max()) < (0.05 if noise_db == -40.0 else 0.3)
    distance = (found.bank.frequency[:, None] / truth.frequency - 1).abs().amin(1)
    assert float((distance > 5e-4).double().mean()) <= 0.05
    assert len(found.bank) <= len(truth.frequency)


def test_gains_are_the_plates():
    impacts, truth = recorded(-60.0)
    found = extract_modes(impacts)
    nearest = (found.bank.frequency[:, None] - truth.frequency).abs().argmin(0)
    scale = float(truth.gains.abs().max())
    assert float((found.gains[:, nearest].real - truth.gains).abs().max()) < 0.01 * scale
    assert float(found.gains.imag.abs().max()) < 0.01 * scale
    level = impacts.sounds.square().mean().sqrt() * 1e-3
    assert abs(float(20 * torch.log10(found.residual.magnitude.square().mean().sqrt() / level))) < 1.0


@pytest.mark.parametrize("seconds", [0.5, 0.8])
def test_a_doublet_three_hertz_apart_is_resolved(seconds: float):
    pair = ModalBank(
        torch.tensor([1250.0, 1681.2, 1684.24], dtype=torch.float64), torch.tensor([8.0, 3.1, 3.1], dtype=torch.float64)
    )
    gains = torch.randn(7, 3, generator=seeded(2))
    sounds = make(pair, gains, rate=RATE, samples=round(seconds * RATE), noise=0.02)
    found = HighResolution().find(sounds, RATE)
    assert len(found) == 3
    torch.testing.assert_close(found.frequency, pair.frequency, rtol=0, atol=0.03)
    torch.testing.assert_close(found.damping, pair.damping, rtol=0.07, atol=0)


# Rates from 170 Hz to 1.5 MHz.
@pytest.mark.parametrize(("scale", "stretch"), [(300.0, 1.0), (1.0, 93.75), (1.0, 1 / 94)])
def test_louder_recordings_have_louder_gains_and_faster_ones_higher_modes(scale: float, stretch: float):
    impacts, _ = recorded(-40.0, seconds=0.25)
    one = extracted(-40.0, 0.25)
    two = extract_sounds(scale * impacts.sounds, sample_rate=RATE * stretch)
    torch.testing.assert_close(two.bank.frequency, stretch * one.bank.frequency, rtol=1e-6, atol=0)
    torch.testing.assert_close(two.bank.damping, stretch * one.bank.damping, rtol=1e-3, atol=0)
    largest = scale * float(one.gains.abs().max())
    torch.testing.assert_close(two.gains, scale * one.gains, rtol=0, atol=1e-5 * largest)
    # In bands where the modes outlast the sound their least rounding decides what is left: .3 dB.
    torch.testing.assert_close(two.residual.magnitude, scale * one.residual.magnitude, rtol=0.035, atol=0)


def test_neither_one_loud_recording_nor_an_offset_changes_modes():
    sounds = recorded(-40.0, seconds=0.25)[0].sounds
    loud = sounds.clone()
    loud[2] *= 1000
    raised = sounds + 10 * sounds.abs().max()
    plain = extracted(-40.0, 0.25).bank.frequency
    others = [HighResolution().find(each, RATE).frequency for each in (loud, raised)]
    torch.testing.assert_close(others[0], plain, rtol=1e-6, atol=0)
    # The mean of a sound is not only its offset, so that the two differ a little.
    torch.testing.assert_close(others[1], plain, rtol=1e-4, atol=0)


def test_hum_is_no_mode():
    impacts, _ = recorded(-40.0, seconds=0.5)
    times = torch.arange(8000) / RATE
    level = float(impacts.sounds.square().mean().sqrt())
    turns = 2 * math.pi * torch.rand(6, 1, generator=seeded(5))
    hum = level * torch.sin(2 * math.pi * 1250.0 * times + turns)
    found = HighResolution().find(impacts.sounds + hum, RATE)
    assert float((found.frequency - 1250.0).abs().min()) > 20.0
    assert abs(len(found) - len(extracted(-40.0, 0.5).bank)) <= 1


def test_at_most_as_many_as_asked_for_are_kept():
    impacts, truth = recorded(-40.0, seconds=0.25)
    few = HighResolution(modes=5).find(impacts.sounds, RATE)
    # Every recording counts alike, however loud.
    level = impacts.sounds.square().mean(1, keepdim=True).sqrt()
    energy = ((truth.gains / level).square() / truth.damping).sum(0)
    strongest = truth.frequency[energy.argsort(descending=True)[:3]]
    assert len(few) == 5
    assert float((few.frequency[:, None] - strongest).abs().amin(0).max()) < 1.0


def test_a_single_sound_is_enough_without_its_contact():
    impacts, truth = recorded(-40.0, seconds=0.25)
    found = extract_sounds(impacts.sounds[:1], sample_rate=RATE)
    assert len(found.bank) > 10
    assert float((found.bank.frequency[:, None] / truth.frequency - 1).abs().amin(1).median()) < 1e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("contacts", [2, 8])
def test_noise_is_blamed(seed: int, contacts: int):
    noise = 0.01 * torch.randn(contacts, 8000, generator=seeded(seed))
    with raises(ExtractionError, name="decay", value=pytest.approx(0.0, abs=1.0)):
        extract_modes(impacts_of(noise))


def thud(frequency: float) -> Tensor:
    times = torch.arange(8000, dtype=torch.float64) / RATE
    fall = torch.exp(-2000 * times) * torch.cos(2 * math.pi * frequency * times)
    noise = 1e-3 * torch.randn(3, 8000, generator=seeded(1))
    return fall.float() * torch.tensor([[1.0], [0.5], [-2.0]]) + noise


def low_tone() -> Tensor:
    """Return a tone of 12 periods, below the 50 that tell a mode from rumble."""
    assert lowest_frequency(8000, RATE) == 100.0
    bank = ModalBank(torch.tensor([24.0], dtype=torch.float64), torch.tensor([12.0], dtype=torch.float64))
    return make(bank, torch.ones(3, 1), rate=RATE, samples=8000, noise=1e-3)


@pytest.mark.parametrize(
    ("sounds", "fault"),
    [
        (lambda: recorded(-40.0, seconds=0.25)[0].sounds[:, :200], {"name": "samples", "value": 200}),
        (low_tone, {"name": "energy", "value": pytest.approx(1.0, abs=0.1)}),
        (lambda: thud(600.0), {"name": "modes", "value": 0}),
        # Sampled in sine phase it is nearly zero, so that its gains would be enormous.
        (lambda: thud(RATE / 2 - 20.0), {"name": "modes", "value": 0}),
        (lambda: torch.zeros(2, 4000), {"name": "sounds", "row": None, "value": 0.0}),
        (lambda: torch.zeros(4, 4000).index_fill(0, torch.tensor([3]), math.nan), {"name": "sounds", "row": 3}),
    ],
)
def test_sounds_without_modes_are_refused_with_the_cause(sounds: Callable[[], Tensor], fault: dict[str, object]):
    with raises(ExtractionError, **fault):
        extract_modes(impacts_of(sounds()))


def test_no_modes_at_all_cannot_be_asked_for() -> None:
    for method in (HighResolution, ShortTime):
        with raises(ExtractionError, name="modes", value=0):
            method(modes=0)


def test_a_kept_file_that_lacks_a_tensor_is_made_again(tmp_path: Path) -> None:
    impacts, path = recorded(-40.0)[0], tmp_path / "modes.safetensors"
    found = extract_once(impacts, HighResolution(modes=4), path)
    with safe_open(path, framework="pt") as file:
        kept, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    del kept["gains"]
    save_file(kept, path, metadata)
    assert torch.equal(extract_once(impacts, HighResolution(modes=4), path).bank.frequency, found.bank.frequency)


def test_the_same_sounds_give_the_same_modes_to_the_last_bit() -> None:
    sounds = strike(Plate(), 4, sample_rate=20000.0, seconds=0.3, noise_db=-20.0, seed=1).sounds
    # Wherever they lie in memory: shifted by one float, which no vector register is aligned to.
    shifted = torch.empty(sounds.numel() + 1)[1:].view_as(sounds).copy_(sounds)
    first, second = (extract_sounds(each, sample_rate=20000.0).bank for each in (sounds, shifted))
    assert torch.equal(first.frequency, second.frequency)
    assert torch.equal(first.damping, second.damping)
