"""Gains refined end to end: where they start, where a shift takes them, and what it costs."""

from functools import cache

import pytest
import torch

from avmsf.field.gains.estimator import RefinedGains
from avmsf.modal.modes import ModalBank
from factories.made_fields import draw, model

CONTACTS, MODES = 14, 5
ORDER = torch.tensor([2, 4, 0])
DAMPING = torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64)


def refined(shift: float = 0.0) -> RefinedGains:
    bank = ModalBank(torch.linspace(400.0, 3000.0, MODES, dtype=torch.float64), DAMPING)
    gains = RefinedGains(model(), bank)
    with torch.no_grad():
        gains.shift += shift * direction()
    return gains


@cache
def direction() -> torch.Tensor:
    return draw(2 * MODES, CONTACTS, 1, seed=4).float()


def read(gains: RefinedGains) -> torch.Tensor:
    found = gains.read(torch.arange(CONTACTS))
    return found.mean.to(torch.complex128).detach()


def mean_at_contacts(gains) -> torch.Tensor:
    found = gains.predict(gains.contacts, gains.training.directions)
    return found.mean.to(torch.complex128)


def test_gains_start_as_the_models_mean_at_the_contacts():
    assert torch.allclose(read(refined()), mean_at_contacts(model()), rtol=1e-4, atol=1e-4)
    assert torch.equal(refined().finished(torch.arange(MODES)).values, model().values)
    assert float(refined().penalty().detach()) == 0.0


def test_a_shift_reads_as_the_model_of_the_moved_values():
    gains = refined(0.01)
    finished = gains.finished(torch.arange(MODES))
    assert float((finished.values - model().values).abs().max()) > 0.1
    assert torch.allclose(read(gains), mean_at_contacts(finished), rtol=1e-4, atol=1e-3)


def test_a_shift_of_one_two_hundredth_moves_a_value_by_its_standard_error():
    gains = refined()
    with torch.no_grad():
        gains.shift[1, 6] = 1.0 / 200.0
        gains.shift[MODES + 3, 2] = -1.0 / 200.0
    moved = torch.view_as_real(gains.finished(torch.arange(MODES)).values - model().values)
    expected = torch.zeros_like(moved)
    expected[6, 1, 0], expected[2, 3, 1] = model().noise()[1, 0], -model().noise()[3, 1]
    assert torch.allclose(moved, expected, rtol=1e-5, atol=1e-9)


def test_a_shift_costs_its_squares_by_the_modes_energy():
    """A mode's energy is its mean square over its damping, as it sounds."""
    share = model().values.abs().square().sum(0) / DAMPING
    share /= share.sum()
    gains = refined(0.01)
    with torch.no_grad():
        # The second mode has nearly all of the energy.
        gains.shift[[1, MODES + 1]] = 0.0
    squares = (200.0 * gains.shift.detach().double()).square().reshape(2, MODES, -1).mean((0, 2))
    assert float(gains.penalty().detach()) == pytest.approx(float(0.05 * (squares * share).sum()), rel=1e-5)


def test_the_finished_model_is_judged_by_the_measured_gains_of_its_recordings():
    """Turned by the phase, one for each mode, that suits the model best."""
    gains = refined(0.01)
    finished = gains.finished(ORDER)
    turn = torch.exp(1j * torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64))
    judged = gains.finished(ORDER, finished.values * turn)
    assert torch.equal(judged.values, finished.values)
    assert torch.allclose(judged.measured, finished.values, rtol=1e-9)
