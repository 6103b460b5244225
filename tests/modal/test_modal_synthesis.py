"""Modes' spectra and their synthesis against sums of damped sines, and distances by cosines."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from avmsf.errors import ArrayError, SimulationError
from avmsf.modal.modes import LARGEST_DELAY, ForcePulse, cosine_distance, synthesize
from avmsf.modal.spectra import envelope, htk_filters, magnitude_stft
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


def test_each_contact_decays_at_its_own_damping():
    gains, frequency, damping = draw()
    own = damping * torch.tensor([[1.0], [2.0], [5.0]], dtype=torch.float64)
    together = synthesize(gains, frequency, own, samples=2000, sample_rate=RATE)
    for row in range(3):
        alone = plain_sum(gains[row : row + 1], frequency, own[row], 2000)
        torch.testing.assert_close(together[row : row + 1], alone, rtol=0, atol=1e-11)


def test_gradients_are_those_of_finite_differences():
    gains, frequency, damping = draw(contacts=1, modes=2)
    # Slow enough that a finite difference in frequency stays in the linear range over the two blocks.
    inputs = [part.requires_grad_() for part in (gains, frequency / 20, damping)]

    def sounds(gains: Tensor, frequency: Tensor, damping: Tensor) -> Tensor:
        return synthesize(gains, frequency, damping, samples=514, sample_rate=RATE)

    assert torch.autograd.gradcheck(sounds, inputs, atol=1e-7)
    own = inputs[2].detach().expand(1, -1).clone().requires_grad_()
    assert torch.autograd.gradcheck(sounds, [inputs[0], inputs[1], own], atol=1e-7)


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


@pytest.mark.parametrize("shape", ["half-sine", "hertz"])
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


def noise(rows: int, samples: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(rows, samples, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("samples", [1, 40, 200, 203])
def test_frames_are_direct_sums_over_centered_windows(samples):
    fft_size, hop = 64, 16
    sound = noise(1, samples)
    magnitudes = magnitude_stft(sound, fft_size=fft_size, hop=hop)
    assert magnitudes.shape == (1, 33, 1 + samples // hop)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(fft_size) / fft_size)
    padded = np.pad(sound[0].numpy(), fft_size // 2)
    for frame in range(magnitudes.shape[2]):
        direct = np.abs(np.fft.rfft(window * padded[frame * hop : frame * hop + fft_size]))
        # Rounding of a sum of 64 terms in float64.
        np.testing.assert_allclose(magnitudes[0, :, frame].numpy(), direct, rtol=0, atol=1e-12)


def test_gradients_are_finite_at_silence_and_right_elsewhere():
    silent = torch.zeros(2, 100, requires_grad=True)
    magnitude_stft(silent, fft_size=32, hop=8).sum().backward()
    assert silent.grad is not None
    assert torch.isfinite(silent.grad).all()
    sound = noise(1, 40).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: magnitude_stft(x, fft_size=16, hop=4), sound)


@pytest.mark.parametrize("samples", [99, 100])
def test_the_envelope_of_a_modulated_sine_is_what_modulates_it(samples):
    turns = 2 * math.pi * torch.arange(samples, dtype=torch.float64) / samples
    factor = 1.0 + 0.5 * torch.cos(3 * turns)
    torch.testing.assert_close(envelope((factor * torch.sin(17 * turns))[None])[0], factor, rtol=0, atol=1e-12)


def test_htk_filters_peak_at_even_mels_and_sum_to_one():
    sample_rate, fft_size = 16000.0, 4096
    filters = htk_filters(20, fft_size=fft_size, sample_rate=sample_rate)
    bins = np.arange(fft_size // 2 + 1) * sample_rate / fft_size
    mel = 2595 * np.log10(1 + bins[filters.argmax(dim=1).numpy()] / 700)
    step = 2595 * math.log10(1 + 8000.0 / 700) / 21
    # A peak is on the bin next to its edge: within half of 3.9 Hz, at most 3 mel at the lowest filter.
    np.testing.assert_allclose(mel, step * np.arange(1, 21), atol=3.0)
    # Neighboring triangles of height one over common edges add up to one between the first and the last peak.
    between = (bins > bins[filters[0].argmax()] + 4) & (bins < bins[filters[-1].argmax()] - 4)
    np.testing.assert_allclose(filters.sum(dim=0).numpy()[between], 1.0, atol=1e-12)


def test_filters_refuse_a_count_that_the_fft_cannot_give():
    with raises(ArrayError, name="count"):
        htk_filters(80, fft_size=128, sample_rate=44100.0)


FREQUENCY = torch.tensor([310.0, 870.0, 1900.0, 3400.0, 5200.0, 8100.0], dtype=torch.float64)
GAINS = torch.randn(40, 6, 2, generator=torch.Generator().manual_seed(0))


def gains() -> torch.Tensor:
    return torch.view_as_complex(GAINS)


def delayed(values: torch.Tensor, seconds: float) -> torch.Tensor:
    turns = torch.polar(torch.ones(6, dtype=torch.float64), 2.0 * math.pi * seconds * FREQUENCY)
    return values.to(torch.complex128) * turns


@pytest.mark.parametrize("delay", [0.0, 1e-5, -1.37e-4, 0.98 * LARGEST_DELAY])
@pytest.mark.parametrize("factor", [1.0, -250.0])
def test_a_point_has_no_distance_from_its_own_gains_of_any_delay_and_sign(delay: float, factor: float) -> None:
    found = cosine_distance(gains(), delayed(factor * gains()[7], delay), FREQUENCY)
    assert int(found.argmin()) == 7
    assert float(found[7]) < 0.01


def test_it_is_the_least_of_a_fine_search_over_delays() -> None:
    recorded = gains()[3].to(torch.complex128) + 0.7 * gains()[9]
    delays = torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, 8001, dtype=torch.float64).tolist()
    turned = torch.stack([delayed(recorded, delay) for delay in delays])
    own = gains().to(torch.complex128)
    match = (own.conj() @ turned.T).real.abs().amax(1) / own.norm(dim=1) / recorded.norm()
    torch.testing.assert_close(cosine_distance(gains(), recorded, FREQUENCY), 1.0 - match, atol=0.01, rtol=0.0)


def test_nothing_is_at_the_greatest_distance() -> None:
    assert bool((cosine_distance(gains(), torch.zeros(6, dtype=torch.complex128), FREQUENCY) == 1.0).all())
    assert float(cosine_distance(0.0 * gains()[:1], delayed(gains()[0], 0.0), FREQUENCY)) == 1.0
