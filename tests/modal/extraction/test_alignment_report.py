"""Faults of recorders and editors, and inverted recordings, are found where they are and nowhere else."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.alignment_report import (
    gain_changes,
    inverted_recordings,
    noise_drop,
    rate_factors,
    uneven_decay,
)
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.finders import HighResolution
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.delayed_plate import cut

RATE, SAMPLES, LEAD, COUNT = 16000.0, 6000, 320, 10
# The first two beat within the sounds.
FREQUENCY = torch.tensor([431.0, 436.0, 902.5, 1370.0, 2204.0, 3317.0], dtype=torch.float64)
DAMPING = torch.tensor([12.0, 13.0, 18.0, 15.0, 30.0, 40.0], dtype=torch.float64)


def files(factors: Tensor) -> Tensor:
    """Return recordings with noise, impacts after `LEAD` samples, each one's frequencies and dampings by its factor."""
    generator = torch.Generator().manual_seed(4)
    gains = torch.randn(COUNT, 6, dtype=torch.float64, generator=generator)
    time = torch.arange(-LEAD, SAMPLES, dtype=torch.float64)[None, :, None] / RATE * factors[:, None, None]
    waves = torch.exp(-DAMPING * time.clamp(min=0)) * (2 * math.pi * FREQUENCY * time).sin() * (time >= 0)
    return waves @ gains[:, :, None] + 0.003 * torch.randn(
        COUNT, LEAD + SAMPLES, 1, dtype=torch.float64, generator=generator
    )


def read(sounds: Tensor) -> Impacts:
    return cut(sounds[:, :, 0], rate=RATE, lead=LEAD, samples=SAMPLES)


def recorded(sounds: Tensor) -> tuple[Extraction, Impacts]:
    return extract_modes(read(sounds), HighResolution(modes=32, range_db=40.0)), read(sounds)


ONES, TIME = torch.ones(COUNT, dtype=torch.float64), torch.arange(-LEAD, SAMPLES)[:, None] / SAMPLES


def test_right_recordings_have_no_fault() -> None:
    modes, impacts = recorded(files(ONES))
    aligned = modes.aligned(impacts)
    assert rate_factors(modes, aligned) == {}
    assert uneven_decay(modes, aligned) is None
    assert noise_drop(modes, impacts) is None
    assert gain_changes(impacts) == {}


@pytest.mark.parametrize("factor", [48 / 44.1, 0.5])
def test_a_recording_of_another_rate_is_named_with_the_ratio(factor: float) -> None:
    factors = ONES.clone()
    factors[3] = factor
    modes, impacts = recorded(files(factors))
    assert rate_factors(modes, modes.aligned(impacts)) == {"03.wav": pytest.approx(factor)}


def test_another_gain_changes_noise_and_sound_alike() -> None:
    sounds = files(ONES)
    gain = torch.ones(COUNT, 1, 1, dtype=torch.float64)
    gain[3] = 0.1
    assert gain_changes(read(sounds * gain)) == {"03.wav": pytest.approx(-20.0, abs=1.5)}
    # A louder room alone is another thing, and so is a softer impact.
    loud = sounds.clone()
    loud[3, :LEAD] *= 10.0
    assert gain_changes(read(loud)) == {}
    soft = sounds.clone()
    soft[3, LEAD:] *= 0.1
    assert gain_changes(read(soft)) == {}


def test_a_fade_out_and_a_noise_gate_are_no_decays() -> None:
    fade = (2 * (1 - TIME)).clamp(max=1.0)
    gate = (TIME < 0.4).double()
    for envelope in (fade, gate):
        modes, impacts = recorded(files(ONES) * envelope)
        found = uneven_decay(modes, modes.aligned(impacts))
        assert found is not None
        assert found > 3.0


def test_an_automatic_gain_leaves_less_noise_after_the_impact_than_before() -> None:
    # Turned down by 26 dB at the impact, and up again within .1 s.
    gain = torch.where(TIME < 0, 1.0, 1 - 0.95 * torch.exp(-TIME.clamp(min=0) * SAMPLES / RATE / 0.1))
    modes, impacts = recorded(gain * files(ONES))
    found = noise_drop(modes, impacts)
    assert found is not None
    assert 3.0 < found < 26.0
    # What is not known before the impact cannot be compared.
    assert impacts.before is not None
    assert noise_drop(modes, replace(impacts, before=torch.full_like(impacts.before, torch.nan))) is None


def beam(contacts: int, *, seed: int = 0) -> tuple[Extraction, Impacts]:
    """Return the gains of a simply supported beam: sin(n pi x) along, each mode with a phase of its own."""
    generator = torch.Generator().manual_seed(seed)
    along = torch.linspace(0.03, 0.97, contacts, dtype=torch.float64)
    number = torch.arange(1, 7, dtype=torch.float64)
    shapes = torch.sin(torch.pi * number * along[:, None]) / number
    shapes = shapes + 0.02 * torch.randn(shapes.shape, dtype=torch.float64, generator=generator)
    phase = torch.rand(6, dtype=torch.float64, generator=generator) * 3
    bank = ModalBank(100 * number.square(), 5 * number)
    modes = Extraction(bank, (shapes * torch.exp(1j * phase)).to(torch.complex64), Residual(torch.zeros(17)))
    points = torch.stack([along, torch.zeros(contacts), torch.zeros(contacts)], dim=1)
    names = tuple(f"{row:03d}.wav" for row in range(contacts))
    return modes, Impacts(points.float(), torch.zeros(contacts, 64), 8000.0, names)


def inverted(modes: Extraction, rows: list[int]) -> Extraction:
    signs = torch.ones(len(modes.gains), 1)
    signs[rows] = -1
    return replace(modes, gains=modes.gains * signs)


def test_each_inverted_recording_is_named_and_no_other() -> None:
    modes, impacts = beam(30)
    assert inverted_recordings(modes, impacts) == ()
    for row in range(30):
        assert inverted_recordings(inverted(modes, [row]), impacts) == (impacts.names[row],)
    assert inverted_recordings(inverted(modes, [2, 7, 20]), impacts) == tuple(impacts.names[row] for row in (2, 7, 20))


def test_opposite_directions_are_no_inversion() -> None:
    modes, impacts = beam(30)
    down = torch.tensor([0.0, 0.0, -1.0]).repeat(30, 1)
    down[5] = -down[5]
    directed = Impacts(impacts.contacts, impacts.sounds, 8000.0, impacts.names, down)
    assert inverted_recordings(inverted(modes, [5]), directed) == ()
    assert inverted_recordings(modes, directed) == (impacts.names[5],)


def test_far_contacts_and_few_recordings_are_not_judged() -> None:
    modes, impacts = beam(30)
    random = torch.randn(modes.gains.shape, generator=torch.Generator().manual_seed(1))
    modes = replace(modes, gains=random + 0j)
    assert inverted_recordings(modes, impacts) == ()
    few, struck = beam(5)
    assert inverted_recordings(inverted(few, [1]), struck) == ()
