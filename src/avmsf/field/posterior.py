"""The posterior over a field's gains, for what is asked of whole fields: edited ones as well as fitted ones."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.gains.model import MixtureGains
from avmsf.field.scaledgains import ScaledGains, fitted_gains
from avmsf.field.soundfield import SoundField


def has_posterior(field: SoundField) -> bool:
    """Return whether the uncertainty of the field's gains is known."""
    try:
        fitted_mixture(field)
    except FitError:
        return False
    return True


def unedited_mixture(field: SoundField) -> MixtureGains:
    """Return the field's gain model, to plan measurements for. Raises as `fitted_mixture`, and for an edited field."""
    if isinstance(field.gain_field, ScaledGains):
        raise FitError("expected a fitted field, got an edited one, which nobody can record: ask the unedited field")
    return fitted_mixture(field)


def fitted_mixture(field: SoundField) -> MixtureGains:
    """Return the gain model that the field was fitted with, beneath its edits.

    Raises FitError where its uncertainty is not known: for the attention network, and for contacts in a single place.
    """
    gains = fitted_gains(field.gain_field)
    if not isinstance(gains, MixtureGains):
        raise FitError(
            f"expected gains of the kind {MixtureGains.kind!r}, got {gains.kind!r}: fit with --gain-model auto"
        )
    if gains.place_count < 2:
        raise FitError("expected gains from 2 places or more, got 1: record impacts in a second place")
    return gains


def scale_of(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the field's gains over the fitted ones: 1, or what an edit has made of each mode."""
    gains = field.gain_field
    return gains.scale if isinstance(gains, ScaledGains) else torch.ones(len(field.bank), dtype=torch.float64)


def training_contacts(field: SoundField) -> Float64[Tensor, "contacts 3"]:
    """Return the contacts that the gains were fitted to, metres, on the object as it is. Raises as `fitted_mixture`."""
    fitted, gains = fitted_mixture(field), field.gain_field
    return gains.contacts.double() if isinstance(gains, ScaledGains) else fitted.contacts


def std_of(
    field: SoundField, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
) -> Float64[Tensor, "contacts modes 2"]:
    """Return the posterior standard deviation of both parts of the gains. Raises as `fitted_mixture`."""
    fitted_mixture(field)
    deviation = field.gain_field.deviation(contacts, directions)
    assert deviation is not None
    return deviation.double()


def energy_of(field: SoundField, gains: Float[Tensor, "contacts modes 2"]) -> Float64[Tensor, " contacts"]:
    """Return the energy of gains in two parts: the sum over audible modes of squares over four times the damping."""
    return (gains.double().square().sum(2) * field.audible / (4.0 * field.bank.damping.double())).sum(1)


def parts_of(
    field: SoundField, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
) -> Float64[Tensor, "contacts modes 2"]:
    """Return both parts of the mean gains."""
    known = field.known(contacts, directions=directions)
    quadrature = torch.zeros_like(known.mean) if known.quadrature is None else known.quadrature
    return torch.stack([known.mean, quadrature], dim=2).double()
