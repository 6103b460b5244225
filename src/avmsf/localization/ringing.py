"""The free decay of an object whose modes are known: propagated from sample to sample, and fitted to a stream."""

from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf.modal.inner_products import gram, poles_of
from avmsf.modal.modes import ModalBank

_QUIET = 1e-12
"""Noise over the power of what is fitted, that is assumed at least: rounding."""
_FAINTEST = 1e-3
"""Strength over the strongest mode's, that every mode has at least beforehand."""


@dataclass(frozen=True, eq=False)
class Ringing:
    """An object's modes at one sample rate, and how strong each is beforehand."""

    poles: Complex128[Tensor, " modes"]
    window: Complex128[Tensor, "window modes"]
    """Powers of the poles."""
    hop: Complex128[Tensor, " modes"]
    """The poles' powers by a hop."""
    scale: Float64[Tensor, " two_modes"]
    """Standard deviation of the sines' and cosines' amplitudes over the object's surface."""
    vectors: Float64[Tensor, "two_modes two_modes"]
    values: Float64[Tensor, " two_modes"]
    """Eigenvectors and -values of the Gram matrix over a window, of amplitudes in units of `scale`: with these the fit
    with any amount of noise is two small products."""

    @classmethod
    def of(
        cls,
        bank: ModalBank,
        size: Float[Tensor, " modes"],
        *,
        sample_rate: float,
        hop: int,
        window: int,
    ) -> "Ringing":
        """Return the ringing of modes that are as strong as `size` on average over the object, in any unit."""
        poles = poles_of(bank, sample_rate)
        relative = size.double() / size.double().max().clamp_min(torch.finfo(torch.float64).tiny)
        scale = relative.clamp_min(_FAINTEST).repeat(2)
        values, vectors = torch.linalg.eigh(gram(poles, window, power=0) * scale[:, None] * scale)
        powers = poles ** torch.arange(window)[:, None]
        return cls(poles, powers, poles**hop, scale, vectors, values.clamp_min(0.0))

    def render(self, amplitudes: Complex128[Tensor, " modes"], length: int) -> Float64[Tensor, " samples"]:
        """Return so many samples of what rings with amplitudes."""
        if length <= len(self.window):
            return (self.window[:length] @ amplitudes).imag
        starts = range(0, length, len(self.window))
        return torch.cat([(self.window[: length - n] @ self.after(amplitudes, n)).imag for n in starts])

    def after(self, amplitudes: Complex128[Tensor, " modes"], samples: int) -> Complex128[Tensor, " modes"]:
        """Return the amplitudes so many samples later."""
        return amplitudes * self.poles**samples

    def fit(self, sound: Float64[Tensor, " window"], noise: float) -> Complex128[Tensor, " modes"]:
        """Return the likeliest amplitudes at a window's beginning, with white noise of this variance beside them.

        Beforehand the modes are as strong as over the object's surface, all by one factor, which the sound's energy
        beyond the noise gives: modes that a window is too short to part do not cancel each other.
        """
        energy = float(sound.square().sum())
        modal = energy - noise * len(sound)
        if not modal > 0.0:
            return torch.zeros_like(self.poles)
        factor = modal / float(self.values.sum())
        share = max(noise, _QUIET * energy / len(sound)) / factor
        products = sound.to(torch.complex128) @ self.window
        both = torch.cat([products.imag, products.real]) * self.scale
        sine, cosine = (self.scale * (self.vectors @ ((both @ self.vectors) / (self.values + share)))).chunk(2)
        return torch.complex(sine, cosine)
