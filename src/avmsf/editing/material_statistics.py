"""Statistics of the objects of one material: distribution of modal frequencies, damping law, and brightness."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import nnls
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf.editing.reference import Reference
from avmsf.errors import EditError
from avmsf.fem.material import Material
from avmsf.field.sound_field import SoundField
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize

_QUANTILES = 64
_POINTS = 64
"""Contacts at which a field's brightness is computed."""
_MODES = 40
"""Modes of a synthetic sound."""
_MIN_RELATIVE_GAIN = 1e-3
"""Gain relative to the object's largest below which a mode does not count for its brightness."""
_SCATTER = 0.5
"""Standard deviation of a mode's gain about the slope, logarithm: contacts and shapes differ."""


@dataclass(frozen=True, eq=False)
class MaterialStatistics:
    """Statistics of a material's sounds."""

    name: str
    frequency: Float64[Tensor, " quantiles"]
    """Quantiles of modal frequencies, at the middles of equal parts of the probability, Hz, ascending."""
    alpha: float
    """1/s: a mode of angular frequency w decays at d = (alpha + beta w^2) / 2."""
    beta: float
    """Seconds."""
    brightness: float
    """Slope of the modes' gains over frequency, decibels an octave."""

    @classmethod
    def of_modes(
        cls, banks: Sequence[ModalBank], gains: Sequence[Float[Tensor, " _modes"]], *, name: str
    ) -> "MaterialStatistics":
        """Sum up objects' modes, each object with the same weight, each mode of an object with its gain's.

        `gains` holds the size of each mode's. The law of decay is fitted by least squares of the relative error with
        both constants not negative, the brightness by least squares over the logarithms of gains within 60 dB of the
        largest. Raises `EditError` where there are no modes, and for an object whose modes are silent or have another
        number of gains.
        """
        if not banks or any(len(bank) == 0 for bank in banks):
            raise EditError.expected(f"modes of every object of {name}", 0, got="none", name="banks")
        if len(banks) != len(gains):
            raise EditError.expected(f"those of all {len(banks)} objects of {name}", len(gains), name="gains")
        for row, (bank, size) in enumerate(zip(banks, gains, strict=True)):
            if len(bank) != len(size):
                raise EditError.expected(f"one for each of {len(bank)} modes", len(size), row=row, name="gains")
            if not (bool(torch.isfinite(size).all()) and bool(size.any())):
                total = float(size.abs().sum())
                got, advice = f"a sum of {total:g}", "omit the object"
                raise EditError.expected("some above 0", total, got=got, row=row, name="gains", advice=advice)
        sizes = [size.double().abs() / size.double().abs().sum() for size in gains]
        frequency, damping = (torch.cat([getattr(bank, each) for bank in banks]) for each in ("frequency", "damping"))
        weight = torch.cat(sizes)
        order = torch.argsort(frequency)
        reached = torch.cumsum(weight[order], dim=0) / weight.sum()
        middles = (torch.arange(_QUANTILES, dtype=torch.float64) + 0.5) / _QUANTILES
        rows = torch.searchsorted(reached, middles).clamp_max(len(order) - 1)
        root = weight.sqrt()[:, None].numpy()
        terms = torch.stack([0.5 / damping, 0.5 * (2 * math.pi * frequency).square() / damping], dim=1).numpy()
        # Scaled alike, for the second constant is a billionth of the first.
        columns = np.abs(terms).max(axis=0)
        law, _ = nnls(root * terms / columns, root[:, 0])
        # Inaudible gains would dominate a slope of logarithms.
        audible = [each > _MIN_RELATIVE_GAIN * each.max() for each in sizes]
        octaves = [torch.log2(bank.frequency[kept]) for bank, kept in zip(banks, audible, strict=True)]
        levels = [20 * torch.log10(each[kept]) for each, kept in zip(sizes, audible, strict=True)]
        # Each object has its own level: the slope is that within objects.
        apart = torch.cat([each - each.mean() for each in octaves])
        loud = torch.cat([each - each.mean() for each in levels])
        spread = float((apart**2).sum())
        slope = float((apart * loud).sum()) / spread if spread > 0 else 0.0
        return cls(name, frequency[order][rows], float(law[0] / columns[0]), float(law[1] / columns[1]), slope)

    @classmethod
    def transform(cls, field: SoundField, old: Material, new: Material) -> "MaterialStatistics":
        """Return what a field's object would be like in another material, by the laws of linear elasticity.

        Its frequencies times sqrt(E'/E r/r'), the new material's damping, its own brightness.
        """
        ratio = math.sqrt(new.young / old.young * old.density / new.density)
        points = field.gain_field.points
        rows = torch.linspace(0, len(points) - 1, min(len(points), _POINTS)).long()
        size = field.known(points[rows]).power.mean(dim=0).sqrt()
        moved = ModalBank(field.bank.frequency * ratio, field.bank.damping)
        found = cls.of_modes([moved], [size], name=new.name)
        return cls(new.name, found.frequency, new.alpha, new.beta, found.brightness)

    def sounds(
        self, count: int, *, samples: int, sample_rate: float, generator: torch.Generator
    ) -> Float[Tensor, "count samples"]:
        """Return synthetic impacts: stratified frequencies, dampings by the law, gains by the slope.

        Raises `EditError` where all modes lie at half the sample rate or above.
        """
        made = []
        for _ in range(count):
            drawn = (torch.arange(_MODES) + torch.rand(_MODES, generator=generator)).double() / _MODES
            place = (drawn * len(self.frequency) - 0.5).clamp(0.0, len(self.frequency) - 1.0)
            below = place.floor().long().clamp_max(len(self.frequency) - 2)
            log = self.frequency.log()
            frequency = torch.exp(torch.lerp(log[below], log[below + 1], place - below))
            turns = torch.rand(_MODES, generator=generator)
            scatter = torch.randn(_MODES, generator=generator)
            audible = frequency < 0.5 * sample_rate
            if not bool(audible.any()):
                lowest, wanted = float(self.frequency[0]), f"some below half the sample rate of {sample_rate:g} Hz"
                raise EditError.expected(wanted, lowest, got=f"{lowest:.4g} Hz and above", name="frequency")
            octave = torch.log2(frequency / frequency[0])
            size = torch.exp(_SCATTER * scatter) * 10 ** (self.brightness * octave / 20)
            damping = 0.5 * (self.alpha + self.beta * (2 * math.pi * frequency).square()).clamp_min(1e-3)
            signed = torch.where(turns < 0.5, -size, size).float()[audible]
            made.append(
                synthesize(signed[None], frequency[audible], damping[audible], samples=samples, sample_rate=sample_rate)
            )
        return torch.cat(made)

    def reference(self, *, samples: int, sample_rate: float, count: int = 8, seed: Seed = None) -> Reference:
        """Return synthetic impacts as the reference of an edit; without a `seed` those of the seed 0."""
        generator = generator_of(seed)
        sounds = self.sounds(count, samples=samples, sample_rate=sample_rate, generator=generator)
        return Reference.of(sounds, sample_rate=sample_rate, name=self.name)
