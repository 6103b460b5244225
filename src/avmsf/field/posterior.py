"""The posterior of a field's gains: over the object, and in a sound's spectrum.

All functions take edited fields as well as fitted ones.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.modal.residual_noise import interpolated

LEVEL = 0.9
"""Probability of credible intervals."""
_MAX_MAPPED_POINTS = 1000
"""Points that the mean over the surface is taken over, at most."""
_DRAWS = 200
"""Sounds that a band is drawn from."""
_MAX_BANDS = 400
"""Bands of a spectrum, evenly spaced up to half the sample rate."""


@dataclass(frozen=True, eq=False)
class SpectrumBand:
    """Credible intervals, of the probability `LEVEL` each, of the spectrum of the sound of one impact."""

    frequencies: Float64[Tensor, " bands"]
    """Middles of the bands, Hz."""
    lower_db: Float64[Tensor, " bands"]
    """Lower end of the interval of each band's level, dB over the loudest band's median."""
    middle_db: Float64[Tensor, " bands"]
    """Median level."""
    upper_db: Float64[Tensor, " bands"]
    """Upper end of the interval."""


def has_posterior(field: SoundField) -> bool:
    """Return whether the uncertainty of the field's gains is known."""
    gains = field.gain_field.fitted
    return isinstance(gains, MixtureGains) and gains.place_count >= 2


def fitted_mixture(field: SoundField) -> MixtureGains:
    """Return the gain model that the field was fitted with, beneath its edits.

    Raises FitError where its uncertainty is not known: for the attention network, and for contacts in a single place.
    """
    gains = field.gain_field.fitted
    if isinstance(gains, BodyGains):
        wanted, got = "one fitted to recordings", "one computed without"
        raise FitError.expected(wanted, gains.kind, got=got, name="field", advice="record impacts and fit")
    if not isinstance(gains, MixtureGains):
        raise FitError.expected(
            f"gains of the kind {MixtureGains.kind!r}", gains.kind, name="field", advice="fit with --gain-model auto"
        )
    if gains.place_count < 2:
        wanted, advice = "recordings at 2 positions or more", "record impacts at another position"
        raise FitError.expected(wanted, gains.place_count, name="field", advice=advice)
    return gains


def scale_of(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the field's gains over the fitted ones: 1, or what an edit has made of each mode."""
    gains = field.gain_field
    return gains.scale if isinstance(gains, ScaledGains) else torch.ones(len(field.bank), dtype=torch.float64)


def posterior(
    field: SoundField, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
    """Return the mean of both parts of the gains, and their standard deviation. Raises as `fitted_mixture`."""
    fitted_mixture(field)
    known = field.gain_field.posterior(contacts, directions)
    assert known.std is not None
    return known.parts, known.std.double()


def energy_of(field: SoundField, gains: Float[Tensor, "contacts modes 2"]) -> Float64[Tensor, " contacts"]:
    """Return the energy of gains in two parts: the sum over audible modes of squares over four times the damping."""
    return (gains.double().square().sum(2) * field.audible / (4.0 * field.bank.damping.double())).sum(1)


def relative_gain_std(field: SoundField, points: Float[Tensor, "points 3"]) -> Float64[Tensor, " points"]:
    """Return the standard deviation of the gains at points (meters) over their root mean square on the object.

    Both as energy over all modes: 0 is certainty; places that may be louder than the mean can have more than 1. Raises
    as `fitted_mixture`.
    """
    surface = field.gain_field.points
    step = max(1, len(surface) // _MAX_MAPPED_POINTS)
    energy = energy_of(field, field.gain_field.predict(surface[::step]).parts).mean()
    variance = energy_of(field, posterior(field, points)[1])
    return (variance / energy.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()


def spectrum_band(field: SoundField, contact: Float[Tensor, " 3"]) -> SpectrumBand:
    """Return the interval of each band of the spectrum of an impact's sound at a contact, meters.

    By drawing sounds: gains from their posterior, and the noise's mean energy added. Raises as `fitted_mixture`.
    """
    mean, spread = (each[0] for each in posterior(field, contact[None]))
    generator = torch.Generator().manual_seed(0)
    drawn = mean + spread * torch.randn(_DRAWS, *mean.shape, generator=generator, dtype=torch.float64)
    power = torch.fft.rfft(field.modal_sounds(Gains(torch.view_as_complex(drawn)), field.samples)).abs().square()
    power += field.samples * interpolated(field.residual.magnitude, power.shape[1]).double().square()
    edges = torch.linspace(0, power.shape[1], min(_MAX_BANDS, power.shape[1]) + 1).round().long()
    bands = torch.stack([power[:, first:last].mean(1) for first, last in pairwise(edges.tolist())], dim=1)
    tail = (1.0 - LEVEL) / 2.0
    ordered = torch.quantile(bands, torch.tensor([tail, 0.5, 1.0 - tail], dtype=torch.float64), dim=0)
    tiny = torch.finfo(torch.float64).tiny
    lower, middle, upper = 10.0 * torch.log10((ordered / ordered[1].max().clamp_min(tiny)).clamp_min(tiny))
    middles = (edges[:-1] + edges[1:] - 1).double() / 2.0 * field.sample_rate / field.samples
    return SpectrumBand(middles, lower, middle, upper)
