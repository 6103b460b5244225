"""The modes of an object, which all contacts share; how they start and sound; how far gains are apart; a pulse's force.

Modes become sound fast and exactly, with gradients. A decaying sine sampled at n = m K + k is the imaginary part of
z^(mK) z^k with z = exp((-d + 2 pi i f) / rate): two small tables make it, one over blocks m and one over the K samples
of a block. Both are made in float64, where the phase of a long sound is still exact; only their product, by far the
larger part of the work, runs in float32 as one matrix product over modes.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Complex64, Complex128, Float, Float64, Inexact
from scipy.special import betainc
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.modal.config import PulseShape


@dataclass(frozen=True, eq=False)
class ModalBank:
    """Damped sines that all contacts share (paper, eq. 3): mode i sounds as exp(-d_i t) sin(2 pi f_i t)."""

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending as extracted and fitted; edits keep the order of the modes."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s, positive."""

    def __repr__(self) -> str:
        if not len(self):
            return "ModalBank(0 modes)"
        ranges = [f"{float(each.min()):.5g} to {float(each.max()):.5g}" for each in (self.frequency, self.damping)]
        return f"ModalBank({len(self)} modes, {ranges[0]} Hz, damping {ranges[1]} 1/s)"

    def __len__(self) -> int:
        return self.frequency.shape[0]

    @property
    def t60(self) -> Float64[Tensor, " modes"]:
        """Time in which each mode falls by 60 dB, s."""
        return math.log(1000) / self.damping

    def take(self, rows: Tensor) -> "ModalBank":
        """Return the modes of these rows or of this mask."""
        return ModalBank(self.frequency[rows], self.damping[rows])

    def join(self, other: "ModalBank") -> "ModalBank":
        """Return these modes and then the others."""
        return ModalBank(torch.cat([self.frequency, other.frequency]), torch.cat([self.damping, other.damping]))


# A hammer's push takes time and sound takes time to the microphone, so that no recording starts as pure sines. The
# contact decides a mode's strength and sign; what shifts its phase, pulse and path to the microphone, stays.
def common_phase(gains: Complex[Tensor, "contacts modes"]) -> Float64[Tensor, " modes"]:
    """Return the phase of each mode, radians in (-pi/2, pi/2], that all contacts agree on best.

    Mode k starts at contact i as Im(c_ik exp(i w t)) with the gain c. The phase p that leaves most energy in the real
    part of c exp(-i p), over all contacts and whatever their signs, is half the argument of the sum over contacts of
    c^2.
    """
    return torch.angle(gains.to(torch.complex128).square().sum(dim=0)) / 2


def turned_like(
    gains: Complex128[Tensor, "contacts modes"], others: Complex128[Tensor, "contacts modes"]
) -> Complex128[Tensor, "contacts modes"]:
    """Return gains with each mode turned, by one phase for all contacts, to where they suit others best.

    A mode whose frequency has moved a little has turned for a sound as a whole, and has the same gains.
    """
    turn = (gains.conj() * others).sum(0)
    return gains * torch.polar(torch.ones_like(turn.real), turn.angle())


LARGEST_DELAY = 5e-4
"""Bound of the onset's error, seconds, either way."""
DELAY_STEP = 0.2
"""Radians that the typical frequency turns by between two delays, of which one is within half of that: a point with the
recorded gains has a distance of .1^2 / 2 = .005 at most. It grows with the square of the frequency where `MOST_DELAYS`
limits them, from 6.4 kHz on, to .05 at 20 kHz."""
MOST_DELAYS = 201
_BATCH = 512
"""Points computed at once: few enough that their arrays stay in a processor's cache."""


def delayed_back(
    values: Complex128[Tensor, " modes"], frequency: Float64[Tensor, " modes"], *, power: Tensor, step: float
) -> tuple[Float64[Tensor, " delays"], Complex64[Tensor, "delays modes"]]:
    """Return evenly spaced delays (seconds) up to `LARGEST_DELAY` either way, zero among them, and amplitudes before.

    From one delay to the next the typical frequency, the root mean square of frequencies (Hz) weighted by `power`,
    turns by `step` radians, or by more where that would take more than `MOST_DELAYS`.
    """
    typical = 2.0 * math.pi * float(((power @ frequency.square()) / power.sum()).sqrt())
    count = min(MOST_DELAYS, 1 + 2 * math.ceil(LARGEST_DELAY * typical / step))
    delays = torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, count, dtype=torch.float64)
    back = torch.polar(torch.ones((), dtype=torch.float64), -2.0 * math.pi * delays[:, None] * frequency)
    return delays, (values * back).to(torch.complex64)


def cosine_distance(
    gains: Complex64[Tensor, "points modes"],
    recorded: Complex128[Tensor, " modes"],
    frequency: Float64[Tensor, " modes"],
) -> Float64[Tensor, " points"]:
    """Return the cosine distance of each point's gains from recorded ones, 0 to 1, whichever sign the recording has.

    Gains are the amplitudes of sines, and of cosines as imaginary part; frequencies are in Hz. Each point has the delay
    of the recording, up to `LARGEST_DELAY`, that makes its distance least: one sample turns high modes by more than
    gains differ between points. A point or a recording without gains has the distance 1.
    """
    if not bool(recorded.any()):
        return torch.ones(len(gains), dtype=torch.float64)
    recorded = recorded / recorded.norm()
    _, rotated = delayed_back(recorded, frequency, power=recorded.abs().square(), step=DELAY_STEP)
    parts = torch.view_as_real(rotated).flatten(1).T.contiguous()
    found = [
        (torch.view_as_real(part).flatten(1) @ parts).abs().amax(1) / part.norm(dim=1).clamp_min(1e-30)
        for part in torch.split(gains, _BATCH)
    ]
    return (1.0 - torch.cat(found).double()).clamp(0.0, 1.0)


_EXPONENTS: dict[str, float] = {"half-sine": 1.0, "hertz": 1.5}


@dataclass(frozen=True)
class ForcePulse:
    """An impact's force over time, of unit impulse: zero before the contact, a power of a half sine, zero after.

    Raises SimulationError for a contact time below 0 or not finite, and for an unknown shape.
    """

    contact_time: float
    """Seconds that hammer and object are in contact; 0 is the impact as recorded."""
    shape: PulseShape = "half-sine"
    """half-sine: a linear contact. hertz: sin^1.5, two curved bodies that flatten each other (Hertz 1881)."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.contact_time < math.inf:
            raise SimulationError.expected("seconds, 0 or more", self.contact_time, name="contact_time")
        if self.shape not in _EXPONENTS:
            raise SimulationError.expected(" or ".join(_EXPONENTS), self.shape, name="shape")

    def samples(self, sample_rate: float) -> Float64[Tensor, " samples"]:
        """Return the part of the impulse that falls into each sample's time; their sum is 1.

        A contact shorter than a sample (sample rate in Hz) is one sample of 1, and nothing jumps as it grows longer.
        """
        count = max(1, math.ceil(self.contact_time * sample_rate))
        if count == 1:
            return torch.ones(1, dtype=torch.float64)
        ends = np.minimum(np.arange(count + 1) / (self.contact_time * sample_rate), 1.0)
        # The integral of sin(pi t)^exponent from 0 to each time, over that from 0 to 1.
        rising = betainc((_EXPONENTS[self.shape] + 1) / 2, 0.5, np.sin(np.pi * ends) ** 2) / 2
        return torch.from_numpy(np.diff(np.where(ends <= 0.5, rising, 1.0 - rising)))

    def soften(
        self, sounds: Float[Tensor, "contacts samples"], *, sample_rate: float
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sounds of this pulse, given those of a pulse of one sample: their causal convolution.

        As long as `sounds`, of their dtype; made in float64.
        """
        pulse = self.samples(sample_rate).to(sounds.device)
        if len(pulse) == 1:
            return sounds
        length = sounds.shape[1] + len(pulse) - 1
        spectrum = torch.fft.rfft(sounds.double(), n=length) * torch.fft.rfft(pulse, n=length)
        return torch.fft.irfft(spectrum, n=length)[:, : sounds.shape[1]].to(sounds.dtype)


_BLOCK = 512
"""Samples in a block: the two tables are smallest together near the square root of the length, the product is
fastest from about 256 on."""


def synthesize(
    gains: Inexact[Tensor, "contacts modes"],
    frequency: Float64[Tensor, "*#contacts modes"],
    damping: Float64[Tensor, "*#contacts modes"],
    phase: Float64[Tensor, " modes"] | None = None,
    *,
    samples: int,
    sample_rate: float,
) -> Float[Tensor, "contacts samples"]:
    """Return the sum over modes of Im(c exp((-d + 2 pi i f) t)): of real gains c sines, as in the paper's eq. 3.

    `frequency` in Hz and `damping` in 1/s, each shared by all contacts or with one row a contact; sines are ahead by
    `phase`, radians, zero without it; differentiable in all of them. Modes at or above half the sample rate would
    alias: the caller leaves them out. The output has the precision of `gains`: in float32 its error is about 1e-7 of
    the loudest sample, in float64 it is exact.
    """
    # As the real part of a exp(i x), since products of complex tables are few calls.
    amplitudes = torch.complex(gains.imag if gains.is_complex() else torch.zeros_like(gains), -gains.real)
    if phase is not None:
        amplitudes = amplitudes * torch.exp(1j * phase).to(amplitudes.dtype)
    blocks = math.ceil(samples / _BLOCK)
    options: dict[str, Any] = {"dtype": torch.float64, "device": amplitudes.device}
    # Those of a block's samples turn backwards, for Re(a b) = Re a Re conj(b) + Im a Im conj(b): a real product.
    counts = torch.arange(0, blocks * _BLOCK, _BLOCK, **options), torch.arange(0, -_BLOCK, -1, **options)
    times = torch.cat(counts)[:, None] / sample_rate
    decay, angle = torch.exp(damping[..., None, :] * -times.abs()), 2 * math.pi * frequency[..., None, :] * times
    # Processors take five times as long for torch.polar in float64.
    powers = torch.complex(decay * torch.cos(angle), decay * torch.sin(angle)).to(amplitudes.dtype)
    starts, steps = torch.tensor_split(powers, [blocks], dim=-2)
    left, right = (torch.view_as_real(each).flatten(-2) for each in (amplitudes[:, None, :] * starts, steps))
    sounds = left.flatten(0, 1) @ right.mT if powers.ndim == 2 else left @ right.mT
    return sounds.reshape(len(amplitudes), blocks * _BLOCK)[:, :samples]
