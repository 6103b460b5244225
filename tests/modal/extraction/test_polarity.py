"""Recordings of inverted sign, among contacts that are near one another and far apart."""

from dataclasses import replace

import torch

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.polarity import inverted_recordings
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual


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
