"""Synthesis against the plain sum and finite differences, and what a hammer's contact time does to a sound."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.modal.modes import ForcePulse
from avmsf.modal.synthesis import synthesize
from factories.raising import raises

RATE = 48000.0


def draw(*, contacts: int = 3, modes: int = 7, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return complex gains, frequencies and dampings, in double precision."""
    generator = torch.Generator().manual_seed(seed)
    gains = torch.complex(*torch.randn(2, contacts, modes, generator=generator, dtype=torch.float64))
    frequency = 100 + 20000 * torch.rand(modes, generator=generator, dtype=torch.float64)
    damping = 1 + 100 * torch.rand(modes, generator=generator, dtype=torch.float64)
    return gains, frequency, damping


def plain_sum(gains: Tensor, frequency: Tensor, damping: Tensor, samples: int) -> Tensor:
    times = torch.arange(samples, dtype=torch.float64) / RATE
    decay = torch.exp(-damping[:, None] * times)
    phase = 2 * math.pi * frequency[:, None] * times
    return gains.real @ (decay * torch.sin(phase)) + gains.imag @ (decay * torch.cos(phase))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-11), (torch.float32, 1e-6)])
@pytest.mark.parametrize("samples", [1, 511, 512, 513, 144000])
def test_blocks_make_the_plain_sum(dtype: torch.dtype, tolerance: float, samples: int):
    gains, frequency, damping = draw()
    expected = plain_sum(gains, frequency, damping, samples)
    found = synthesize(gains.to(dtype.to_complex()), frequency, damping, samples=samples, sample_rate=RATE)
    assert found.dtype == dtype
    assert found.shape == (3, samples)
    assert float((found - expected).abs().max()) < tolerance * float(expected.abs().max())


def test_gradients_are_those_of_finite_differences():
    gains, frequency, damping = draw(contacts=1, modes=2)
    # Slow enough that a finite difference in frequency stays in the linear range over the two blocks.
    inputs = [part.requires_grad_() for part in (gains, frequency / 20, damping)]

    def sounds(gains: Tensor, frequency: Tensor, damping: Tensor) -> Tensor:
        return synthesize(gains, frequency, damping, samples=514, sample_rate=RATE)

    assert torch.autograd.gradcheck(sounds, inputs, atol=1e-7)
    own = inputs[2].detach().expand(1, -1).clone().requires_grad_()
    assert torch.autograd.gradcheck(sounds, [inputs[0], inputs[1], own], atol=1e-7)


def test_each_contact_decays_at_its_own_damping():
    gains, frequency, damping = draw()
    own = damping * torch.tensor([[1.0], [2.0], [5.0]], dtype=torch.float64)
    together = synthesize(gains, frequency, own, samples=2000, sample_rate=RATE)
    for row in range(3):
        alone = plain_sum(gains[row : row + 1], frequency, own[row], 2000)
        torch.testing.assert_close(together[row : row + 1], alone, rtol=0, atol=1e-11)


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
