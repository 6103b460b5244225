"""The posterior of a field's gains over the object.

All functions take edited fields as well as fitted ones.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SoundField

_MAX_MAPPED_POINTS = 1000
"""Points that the mean over the surface is taken over, at most."""


def has_posterior(field: SoundField) -> bool:
    """Return whether the uncertainty of the field's gains is known."""
    gains = field.gain_field.fitted
    return isinstance(gains, MixtureGains) and gains.place_count >= 2


def fitted_mixture(field: SoundField) -> MixtureGains:
    """Return the gain model that the field was fitted with, beneath its edits.

    Raises FitError where its uncertainty is not known: for the attention network, a guess without recordings, and
    contacts in a single place.
    """
    gains = field.gain_field.fitted
    if not isinstance(gains, MixtureGains):
        wanted, advice = f"gains of the kind {MixtureGains.kind!r}", "fit recordings with --gain-model auto"
        raise FitError.expected(wanted, gains.kind, name="field", advice=advice)
    if gains.place_count < 2:
        wanted, advice = "recordings at 2 positions or more", "record impacts at another position"
        raise FitError.expected(wanted, gains.place_count, name="field", advice=advice)
    return gains


def scale_of(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the field's gains over the fitted ones: 1, or what an edit has made of each mode."""
    gains = field.gain_field
    return gains.scale if isinstance(gains, ScaledGains) else torch.ones(len(field.bank), dtype=torch.float64)


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
    fitted_mixture(field)
    std = field.gain_field.posterior(points).std
    assert std is not None
    variance = energy_of(field, std)
    return (variance / energy.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()
