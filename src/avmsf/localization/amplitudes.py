"""How strongly known modes sound in one sound, and how sure that is: least squares in closed form, with its errors.

With B the modes' sines and cosines, sampled, the amplitudes that fit a sound y best are c = G^-1 B' y, G = B' B, and
noise of variance s^2 in every sample errs them by the covariance s^2 G^-1. Both matrices are known in closed form
(`avmsf.modal.inner_products`), so that an answer costs the products B' y alone. A mode's two amplitudes are one complex
number, sine + i cosine. Modes that the sound is too short to tell apart err together, and strongly: `separated` turns
them into mixtures whose errors have nothing to do with one another.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Complex128, Float, Float64
from scipy.fft import next_fast_len
from scipy.signal import resample
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import interpolate

from avmsf.modal.inner_products import gram, poles_of, project
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual

_RIDGE = 1e-10
"""Relative to the Gram matrix's diagonal: two modes that a short sound cannot tell apart share what they explain."""
_COHERENT = 0.5
"""Correlation between the errors of two modes from which on they are looked at together."""
_BAND = 512
"""Samples of the frames that the noise's power is measured in, at most."""
_MAX_STRETCH = 0.004
"""Largest change of time, relative. Frequencies of steel fall by .01 % per kelvin, plastics' several times as fast."""
_STRETCH_DEVIATION = 0.001
"""Its prior standard deviation."""
_SHORTEST = 0.1
"""Seconds of the shortest beginning in which it is searched for; four samples per amplitude are the least, too."""
_FIRST_STEPS, _STEPS = 33, 9
"""Factors that are tried in the first beginning over the whole range, and in each later one between two of those."""
_BAND_BINS = 256
"""Bins of the bands whose evidence for it is added up, at most."""
_FINER = 8
"""Samples that a sound is interpolated between linearly, for each of its own: .1 % is lost at a tenth of its rate."""
_NOISE_QUANTILE = 0.25
"""Part of the bands, and of their frames, that count as quiet."""


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """What a sound has of each mode."""

    values: Complex128[Tensor, " modes"]
    """Amplitudes of exp(-d t) sin(2 pi f t), and of exp(-d t) cos(2 pi f t) as imaginary part, in the sound's unit."""
    noise: Float64[Tensor, " modes"]
    """Variance of the noise per sample near each mode's frequency, as if it were white."""
    products: Float64[Tensor, " two_modes"]
    """The sound's inner products with all sines, then with all cosines."""
    energy: float
    """Sum of the sound's squares, without what is noise."""

    @property
    def fitted(self) -> float:
        """The energy that the modes explain, free to sound as strongly as they like, in the unit of `energy`."""
        return float(torch.cat([self.values.real, self.values.imag]) @ self.products)

    def part(self, energy: float) -> float:
        """Return an energy as part of the sound's, 0 to 1."""
        return min(1.0, max(0.0, energy / self.energy)) if self.energy > 0 else 0.0


class Extractor:
    """All that the amplitudes of a bank's modes, all below half the sample rate, need in sounds of one length."""

    def __init__(self, bank: ModalBank, *, sample_rate: float, samples: int, highest: float = math.inf) -> None:
        """Prepare for sounds of that many `samples` at `sample_rate` Hz, which hold anything up to `highest` Hz."""
        self.bank, self.sample_rate, self.samples = bank, sample_rate, samples
        self.highest = min(highest, 0.5 * sample_rate)
        self.gram = gram(poles_of(bank, sample_rate), samples, power=0)
        """Inner products of all sines and cosines, [two_modes, two_modes]."""
        scale = torch.sqrt(torch.diagonal(self.gram))
        ridge = _RIDGE * torch.eye(len(scale), dtype=self.gram.dtype)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(self.gram / (scale[:, None] * scale) + ridge))
        self.inverse = inverse / (scale[:, None] * scale)
        """Its inverse: the covariance of the amplitudes' errors where the noise has variance one."""

    @cached_property
    def separated(self) -> tuple[Complex128[Tensor, "modes modes"], Float64[Tensor, " modes"]]:
        """Mixing, unitary, whose conjugate transpose makes mixtures of amplitudes with uncorrelated errors; and spread.

        Spread is the variance of each mixture's error where the noise has variance one. Only modes that hang together
        are mixed. What tells sine from cosine in a mode's errors is left out: it is little for a mode that turns more
        than once before it ends.
        """
        modes = len(self.bank)
        sine, cosine = self.inverse[:modes, :modes], self.inverse[modes:, modes:]
        mixed = self.inverse[modes:, :modes]
        covariance = torch.complex(sine + cosine, mixed - mixed.T)
        spread = torch.diagonal(covariance).real.clone()
        coherence = covariance.abs() / (spread.sqrt()[:, None] * spread.sqrt())
        mixing = torch.eye(modes, dtype=torch.complex128)
        _, groups = connected_components(csr_array((coherence > _COHERENT).numpy()), directed=False)
        for label in np.flatnonzero(np.bincount(groups) > 1):
            group = torch.from_numpy(np.flatnonzero(groups == label))
            values, vectors = torch.linalg.eigh(covariance[group][:, group])
            spread[group] = values.clamp_min(torch.finfo(torch.float64).tiny)
            mixing[group[:, None], group[None]] = vectors
        return mixing, spread

    def extract(self, sound: Float[Tensor, " samples"], *, color: Residual | None) -> Amplitudes:
        """Return the amplitudes in a sound; `color` is the noise to expect, of which the shape alone counts.

        Its level is measured in the sound's own quiet bands, and where a band holds more than that which the modes
        leave over, it is taken to be as noisy as it is. Without `color` there is no noise.
        """
        products, _ = project(sound[None], poles_of(self.bank, self.sample_rate))
        both = self.inverse @ products[0]
        values = torch.complex(*both.chunk(2))
        energy = float(sound.double().square().sum())
        if color is None:
            return Amplitudes(values, torch.zeros_like(self.bank.frequency), products[0], energy)
        power, floor = self._noise(sound, values, color)
        place = self.bank.frequency / (0.5 * self.sample_rate) * (len(power) - 1)
        left = place.floor().long().clamp(0, len(power) - 2)
        noise = torch.lerp(power[left], power[left + 1], place - left)
        return Amplitudes(values, noise, products[0], max(energy - self.samples * floor, 0.0))

    def stretched_to_modes(self, sound: Float[Tensor, " sound"]) -> Float[Tensor, " samples"]:
        """Return a sound of any length as long as prepared for, with its time stretched so that it has these modes.

        An object that has warmed or cooled sounds higher or lower by one factor, taken as .4 % at most. The most
        probable one is searched for in the sound's beginning, where the probability is broad, then around it in longer
        ones.
        """
        used = sound[: math.ceil((1.0 + _MAX_STRETCH) * self.samples)].double().numpy()
        # Silence after the end, which is the beginning's neighbor in the discrete Fourier transform.
        padded = np.pad(used, (0, next_fast_len(max(len(used), self.samples) + _BAND) - len(used)))
        finer = resample(padded, _FINER * len(padded))
        factor, reach, steps = 1.0, _MAX_STRETCH, _FIRST_STEPS
        for extractor in self.beginnings:
            tried = np.append(np.linspace(factor - reach, factor + reach, steps), 1.0)
            tried = tried.clip(1.0 - _MAX_STRETCH, 1.0 + _MAX_STRETCH)
            factor = float(tried[int(extractor._log_probability(finer, tried).argmax())])
            reach, steps = 2.0 * reach / (steps - 1), _STEPS
        return _stretched(finer, factor, self.samples).to(sound)

    @cached_property
    def beginnings(self) -> list["Extractor"]:
        """Extractors for the first sixteenth of a sound, its first quarter and all of it, without too short ones."""
        lengths = [math.ceil(part * self.samples) for part in (1 / 16, 1 / 4)]
        shortest = max(_SHORTEST * self.sample_rate, 8 * len(self.bank))
        about = {"sample_rate": self.sample_rate, "highest": self.highest}
        return [*(Extractor(self.bank, samples=each, **about) for each in lengths if each >= shortest), self]

    def _log_probability(
        self, finer: Float64[np.ndarray, " finer"], factors: Float64[np.ndarray, " factors"]
    ) -> Float64[Tensor, " factors"]:
        """Return the log probability of factors on time, up to a constant: the sum of all bands' evidence of modes.

        By Zellner's g-prior, with g by maximum likelihood in each band: modes beneath the noise tell nothing, and noise
        of one band nothing of another.
        """
        begins = torch.stack([_stretched(finer, factor, self.samples) for factor in factors.tolist()])
        both = project(begins, poles_of(self.bank, self.sample_rate))[0] @ self.inverse
        made = self._sounds(torch.complex(*both.chunk(2, dim=1)))
        spectra = [torch.fft.rfft(each).abs().square() for each in (begins, begins - made)]
        bands = max(2, math.ceil(spectra[0].shape[1] / _BAND_BINS))
        rows = torch.arange(spectra[0].shape[1]) * bands // spectra[0].shape[1]
        places = (self.bank.frequency / (0.5 * self.sample_rate) * bands).long().clamp_max(bands - 1)
        counts = torch.bincount(places)
        used = torch.nonzero(counts).flatten()
        bins, amplitudes = 2.0 * torch.bincount(rows)[used], 2.0 * counts[used]
        whole, left = (
            torch.zeros(len(each), bands, dtype=torch.float64).index_add_(1, rows, each)[:, used] for each in spectra
        )
        unexplained, free = (left / whole.clamp_min(1e-300)).clamp(1e-12, 1.0), bins - amplitudes
        g = ((1.0 / unexplained - 1.0) * free / amplitudes - 1.0).clamp_min(0.0)
        evidence = 0.5 * free * torch.log1p(g) - 0.5 * bins * torch.log1p(g * unexplained)
        return evidence.sum(1) - 0.5 * ((torch.from_numpy(factors) - 1.0) / _STRETCH_DEVIATION).square()

    def explained(self, sound: Float[Tensor, " samples"]) -> float:
        """Return the energy of a sound that the modes explain, noise included."""
        products = project(sound[None], poles_of(self.bank, self.sample_rate))[0][0]
        return float(products @ self.inverse @ products)

    def _sounds(self, values: Complex128[Tensor, "sounds modes"]) -> Float64[Tensor, "sounds samples"]:
        """Return the sounds that amplitudes make, without noise."""
        bank, rate = self.bank, self.sample_rate
        return synthesize(values, bank.frequency, bank.damping, samples=self.samples, sample_rate=rate)

    def _noise(
        self, sound: Float[Tensor, " samples"], values: Complex128[Tensor, " modes"], color: Residual
    ) -> tuple[Float64[Tensor, " bands"], float]:
        """Return the noise's power in bands up to half the sample rate, and on the mean what is there throughout."""
        rest = sound.double() - self._sounds(values[None])[0]
        # Each amplitude takes its share of the noise away.
        free = self.samples / max(self.samples - 2 * len(self.bank), 0.5 * self.samples)
        # Overlapping frames, in whose bands white noise of variance v has a mean power of v.
        size = min(_BAND, 2 ** int(math.log2(max(self.samples // 2, 2))))
        window = torch.hann_window(size, dtype=torch.float64)
        power = torch.fft.rfft(rest.unfold(0, size, size // 2) * window).abs().square()
        cells = free * (power / window.square().sum())
        own = cells.mean(0)
        shape = interpolate(color.magnitude.double()[None, None], len(own), mode="linear", align_corners=True)[0, 0]
        shape = shape.square()
        if not bool(shape.any()):
            shape = torch.ones_like(own)
        shape = shape.clamp_min(1e-6 * float(shape.mean()))
        # Bands that resampling has emptied are the quietest of all, and tell nothing of the noise in the others.
        held = max(2, int(self.highest / (0.5 * self.sample_rate) * len(own)))
        level = shape * torch.quantile((own / shape)[:held], _NOISE_QUANTILE)
        # Noise's power in a cell is distributed exponentially, so that a quiet cell tells the mean. What dies away is
        # no noise, however broad: its later cells are quiet.
        even = (cells / shape)[:, :held].flatten()
        low = float(torch.kthvalue(even, max(1, round(_NOISE_QUANTILE * len(even)))).values)
        steady = low / -math.log1p(-_NOISE_QUANTILE)
        return torch.maximum(own, level), float(shape[:held].sum()) / len(shape) * steady


def _stretched(finer: Float64[np.ndarray, " finer"], factor: float, samples: int) -> Float64[Tensor, " samples"]:
    """Return the first samples of a sound with its time times a factor, of its values at `_FINER` times the rate."""
    return torch.from_numpy(np.interp(np.arange(samples) * (_FINER / factor), np.arange(len(finer)), finer))
