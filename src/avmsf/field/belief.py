"""What a field believes of gains together: how uncertain they are at places, and how that hangs together."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.doubtedgains import Belief, DoubtedGains
from avmsf.field.kinds import FITTED
from avmsf.field.scaledgains import ScaledGains, fitted_gains
from avmsf.field.soundfield import SoundField


def knows_doubt(field: SoundField) -> bool:
    """Return whether the field knows how sure it is of its gains."""
    try:
        measured_gains(field)
    except FitError:
        return False
    return True


def expect_doubt(field: SoundField) -> DoubtedGains:
    """Return the field's gains, to learn more of. Raises as `measured_gains`, and for an edited field."""
    if isinstance(field.gain_field, ScaledGains):
        raise FitError("the field was edited, and no blow tells more of what nobody can strike: ask the unedited field")
    return measured_gains(field)


def measured_gains(field: SoundField) -> DoubtedGains:
    """Return the gains that the field's doubt rests on: its own, or those that an edited field was made from.

    Raises FitError where they know no doubt, with the kinds that do.
    """
    gains = fitted_gains(field.gain_field)
    if not isinstance(gains, DoubtedGains):
        known = " and ".join(kind for kind, fitted in FITTED.items() if hasattr(fitted, "beliefs"))
        raise FitError(f"gains of the kind {gains.kind!r} do not know how sure they are; {known} do: fit with these")
    if gains.places < 2:
        raise FitError("gains from a single place say nothing of how sure they are elsewhere: strike a second place")
    return gains


def scale_of(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the field's gains over the fitted ones: 1, or what an edit has made of each mode."""
    gains = field.gain_field
    return gains.scale if isinstance(gains, ScaledGains) else torch.ones(len(field.bank), dtype=torch.float64)


def struck_at(field: SoundField) -> Float64[Tensor, "contacts 3"]:
    """Return the contacts that the gains were fitted to, metres, on the object as it is. Raises as `measured_gains`."""
    measured = measured_gains(field)
    gains = field.gain_field
    return gains.contacts.double() if isinstance(gains, ScaledGains) else measured.contacts.double()


def deviation_of(
    field: SoundField, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
) -> Float64[Tensor, "contacts modes 2"]:
    """Return the standard deviation of both parts of the gains, as the field has it. Raises as `measured_gains`."""
    measured_gains(field)
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


def beliefs(
    field: SoundField, places: Float64[Tensor, "places 3"], directions: Float64[Tensor, "places 3"] | None
) -> Iterator[Belief]:
    """Return what is not known of all modes' gains of blows at places.

    With physics, of each mode by its likeliest hypothesis; of splines all modes' at once, by kriging. Raises FitError
    for other gains, and for an edited field's.
    """
    weights = 1.0 / (4.0 * field.bank.damping.double())
    return expect_doubt(field).beliefs(places, directions, weights=weights)


def left_out(field: SoundField) -> Float64[Tensor, "contacts modes 2"]:
    """Return by how much each contact's gains are missed by all others', over the deviation foretold of that.

    The gains as measured with the field's own modes: those that the end-to-end stage moved suit one another too well.
    An edit, which scales errors and deviations alike, changes nothing of it. Contacts that are doubted have no part,
    and NaN stands for parts of modes without any gains. Raises FitError for gains that know no doubt.
    """
    return measured_gains(field).left_out()
