"""How sure a field is, for people: over the object, in a sound's spectrum, and whether held-out gains agree."""

from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.posterior import energy_of, fitted_mixture, parts_of, scale_of, std_of
from avmsf.field.soundfield import SoundField
from avmsf.modal.phase import turned_like
from avmsf.modal.synthesis import synthesise_phased

LEVEL = 0.9
"""How likely intervals are to hold the truth, where nothing else is asked for."""
_MAPPED = 1000
"""Points that the mean over the surface is taken over, at most."""
_DRAWS = 200
"""Sounds that a band is drawn from."""
_BANDS = 400
"""Bands of a spectrum, evenly spaced up to half the sample rate."""
_BATCH = 16
"""Modes whose spectra are made at once."""


@dataclass(frozen=True, eq=False)
class SpectrumBand:
    """Where the spectrum of the sound of one blow is believed to lie."""

    frequencies: Float64[Tensor, " bands"]
    """Middles of the bands, Hz."""
    lower_db: Float64[Tensor, " bands"]
    """Level of each band's energy below which it is not expected, dB over the loudest band's middle."""
    middle_db: Float64[Tensor, " bands"]
    """Level that is as likely to be surpassed as not."""
    upper_db: Float64[Tensor, " bands"]
    """Level above which it is not expected."""
    level: float
    """How likely each band's level is to lie between."""


@dataclass(frozen=True)
class Coverage:
    """How many measured gains lie within the interval that was foretold of them."""

    plain: float
    """Part of the gains, each counted alike."""
    by_energy: float
    """The same, each counted by its mode's energy."""


def gain_doubt(field: SoundField, points: Float[Tensor, "points 3"]) -> Float64[Tensor, " points"]:
    """Return how unsure the gains at points are (metres), over their size on the mean over the object.

    The root of all modes' variances as energy over the root of the mean energy of gains: 0 is certainty; places that
    may ring louder than the mean can have more than 1. Raises FitError for gains that know no doubt.
    """
    surface = field.gain_field.points
    step = max(1, len(surface) // _MAPPED)
    energy = energy_of(field, parts_of(field, surface[::step])).mean()
    doubt = energy_of(field, std_of(field, points))
    return (doubt / energy.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()


def spectrum_band(
    field: SoundField,
    contact: Float[Tensor, " 3"],
    *,
    direction: Float[Tensor, " 3"] | None = None,
    level: float = LEVEL,
    seed: int = 0,
) -> SpectrumBand:
    """Return where the spectrum of a blow's sound lies with a probability of `level`, in each band for itself.

    By drawing sounds: gains about their mean as unsure as they are, and the noise's energy beside them. `contact` in
    metres, `direction` as in `SoundField.render`, `seed` for the draws. Raises FitError for gains that know no doubt,
    and for a level that is not between 0 and 1.
    """
    _expect_level(level)
    contacts, along = contact[None], None if direction is None else direction[None]
    mean, spread = parts_of(field, contacts, along)[0], std_of(field, contacts, along)[0]
    generator = torch.Generator().manual_seed(seed)
    drawn = mean + spread * torch.randn(_DRAWS, *mean.shape, generator=generator, dtype=torch.float64)
    spectra = torch.zeros(_DRAWS, field.samples // 2 + 1, dtype=torch.complex128)
    for modes in torch.split(torch.nonzero(field.audible).flatten(), _BATCH):
        spectra += torch.einsum("amd,mdf->af", drawn[:, modes].to(spectra), _spectra(field, modes))
    place = torch.linspace(0, len(field.residual.magnitude) - 1, spectra.shape[1])
    left = place.floor().long().clamp_max(len(field.residual.magnitude) - 2)
    noise = torch.lerp(field.residual.magnitude[left], field.residual.magnitude[left + 1], place - left)
    power = spectra.abs().square() + field.samples * noise.double().square()
    edges = torch.linspace(0, power.shape[1], min(_BANDS, power.shape[1]) + 1).round().long()
    bands = torch.stack([power[:, first:last].mean(1) for first, last in pairwise(edges.tolist())], dim=1)
    tail = (1.0 - level) / 2.0
    ordered = torch.quantile(bands, torch.tensor([tail, 0.5, 1.0 - tail], dtype=torch.float64), dim=0)
    tiny = torch.finfo(torch.float64).tiny
    lower, middle, upper = 10.0 * torch.log10((ordered / ordered[1].max().clamp_min(tiny)).clamp_min(tiny))
    middles = (edges[:-1] + edges[1:] - 1).double() / 2.0 * field.sample_rate / field.samples
    return SpectrumBand(middles, lower, middle, upper, level)


def coverage(
    field: SoundField,
    contacts: Float[Tensor, "contacts 3"],
    parts: Float64[Tensor, "contacts modes 2"],
    *,
    directions: Float[Tensor, "contacts 3"] | None = None,
    level: float = LEVEL,
) -> Coverage:
    """Return which part of the gains measured at other contacts lies in the interval of this level.

    `parts` as `GainCase.parts`: amplitudes along each of the field's modes' phases and a quarter of a period ahead, of
    each mode up to a phase that all contacts share, of each contact up to their common sign where the field knows no
    directions of blows. The interval is normal, with the posterior standard deviation of a measured gain, so it holds
    the scatter of an impact as well. Raises FitError for gains without a posterior and for gains of other modes.
    """
    _expect_level(level)
    gains, scale = fitted_mixture(field), scale_of(field).square()[:, None]
    if parts.shape != (len(contacts), len(field.bank), 2):
        raise FitError(
            f"gains are of shape {tuple(parts.shape)}: expected {len(contacts)} contacts, the field's "
            f"{len(field.bank)} modes and 2 parts"
        )
    deviation = std_of(field, contacts, directions)
    spread = (deviation.square() + scale * gains.noise().square()).sqrt()
    foretold = parts_of(field, contacts, directions)
    parts = turned_like(parts, foretold)
    within = (parts - foretold).abs() <= _normal(level) * spread
    energy = (
        scale * torch.view_as_real(gains.values).square().mean(0) / (4.0 * field.bank.damping.double())[:, None]
    ).expand_as(parts)
    return Coverage(float(within.double().mean()), float((within * energy).sum() / energy.sum()))


def _spectra(field: SoundField, modes: Tensor) -> Tensor:
    """Return the spectrum of each mode by itself, [modes, 2, frequencies], of a gain of one in either part."""
    count = len(modes)
    one, none = torch.eye(count, dtype=torch.float64), torch.zeros(count, count, dtype=torch.float64)
    sounds = [
        synthesise_phased(
            first,
            field.bank.frequency[modes],
            field.bank.damping[modes],
            field.phase[modes],
            samples=field.samples,
            sample_rate=field.sample_rate,
            quadrature=second,
        )
        for first, second in ((one, none), (none, one))
    ]
    return torch.fft.rfft(torch.stack(sounds, dim=1))


def _normal(level: float) -> float:
    return NormalDist().inv_cdf(0.5 + level / 2.0)


def _expect_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise FitError(f"level = {level:g}: expected a probability between 0 and 1, as .9")
