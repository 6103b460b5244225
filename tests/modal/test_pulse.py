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


@pytest.mark.parametrize(("shape", "power"), [("half-sine", 1.0), ("hertz", 1.5)])
@pytest.mark.parametrize("contact", [0.08, 1.36, 10.4, 24.8])
def test_each_sample_holds_the_force_of_its_time_of_an_impulse_of_one(shape, power, contact):
    """Against numerical integration of sin^power, whole samples and the last, cut one."""
    pulse = ForcePulse(contact / RATE, shape).samples(RATE)
    assert len(pulse) == math.ceil(contact)

    def force(time: float) -> float:
        return math.sin(math.pi * time / contact) ** power

    whole = quad(force, 0, contact)[0]
    parts = [quad(force, row, min(row + 1, contact))[0] for row in range(len(pulse))]
    assert pulse.tolist() == pytest.approx([part / whole for part in parts], abs=1e-9)
    assert ForcePulse(0.0, shape).samples(RATE).tolist() == [1.0]


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
