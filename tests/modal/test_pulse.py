"""What a hammer's contact time does to a sound, against closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from avmsf.errors import SimulationError
from avmsf.modal.modes import ForcePulse
from factories.raising import raises

RATE = 8000.0
SHAPES = ("half-sine", "hertz")


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("contact_time", [0.0, 1e-5, 1.7e-4, 1e-3, 3.1e-3])
def test_the_impulse_is_one_whatever_the_contact_time(shape, contact_time):
    pulse = ForcePulse(contact_time, shape).samples(RATE)
    assert float(pulse.sum()) == pytest.approx(1.0, abs=1e-12)
    assert float(pulse.min()) >= 0.0
    assert len(pulse) == max(1, math.ceil(contact_time * RATE))


@pytest.mark.parametrize(("shape", "power"), [("half-sine", 1.0), ("hertz", 1.5)])
def test_each_sample_holds_the_force_of_its_time(shape, power):
    """Against numerical integration of sin^power, whole samples and the last, cut one."""
    contact = 10.4
    pulse = ForcePulse(contact / RATE, shape).samples(RATE)

    def force(time: float) -> float:
        return math.sin(math.pi * time / contact) ** power

    whole = quad(force, 0, contact)[0]
    for row in (0, 3, 5, 10):
        part = quad(force, row, min(row + 1, contact))[0]
        assert float(pulse[row]) == pytest.approx(part / whole, abs=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_softening_is_a_causal_convolution(shape):
    sounds = torch.randn(2, 300, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pulse = ForcePulse(2e-3, shape)
    expected = [np.convolve(sound, pulse.samples(RATE))[:300] for sound in sounds.numpy()]
    torch.testing.assert_close(
        pulse.soften(sounds, sample_rate=RATE), torch.from_numpy(np.stack(expected)), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("contact_time", [-1e-3, math.nan, math.inf])
def test_a_time_that_is_none_is_refused(contact_time):
    with raises(SimulationError, name="contact_time") as caught:
        ForcePulse(contact_time)
    assert caught.value.value is contact_time
