"""How well a field predicts its own contacts from each other, where it should be recorded next, and its residual."""

from dataclasses import asdict, replace

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.field.gainfield import Gains
from avmsf.field.gains.model import MixtureGains
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.soundfield import FieldQuality, SoundField
from avmsf.field.suggest import suggest
from avmsf.modal.residual import Residual

MIN_PLACES = 4
"""Places below which leaving one out says nothing of the field of all."""


def with_quality(field: SoundField, train: Impacts, *, advise: bool = True) -> SoundField:
    """Return a field with the residual that predicts its own contacts best, and its quality in the report.

    The residual is the stationary noise of the field, or the mean of what the three nearest recordings have in
    addition to their modes, by the error at contacts left out. `train` holds the recordings that the gain model uses,
    row for row. A field of fewer than `MIN_PLACES` places keeps its noise and has no quality. `advise`: whether to name
    the contact to record next, one of the field's points; not if these are not on the object.
    """
    gains = field.gain_field
    if not isinstance(gains, MixtureGains) or gains.place_count < MIN_PLACES:
        return field
    samples, places = train.sounds.shape[1], gains.places
    modes, fitted = (
        field.modal_sounds(Gains(each.real.float(), each.imag.float()), samples)
        for each in (gains.leave_one_out(), gains.values)
    )
    errors = {"noise": _error(field, modes + field.noise(samples), train)}
    recordings = (train.sounds - fitted).float()
    rows, signs = gains.nearest(gains.training, places)
    averaged = (train.sounds[rows] * signs[..., None]).float().mean(1)
    if field.origin.config.residual:
        errors["recordings"] = _error(field, modes + (recordings[rows] * signs[..., None]).mean(1), train)
    best = min(errors, key=lambda each: errors[each])
    if best == "recordings":
        field = replace(field, residual=Residual(field.residual.magnitude, recordings))
    advice = _next(field, gains) if advise else ()
    found = FieldQuality(gains.place_count, errors[best], _error(field, averaged, train), *advice)
    report = {**field.origin.report, "quality": asdict(found), "residual": errors}
    return replace(field, origin=replace(field.origin, report=report))


def _next(field: SoundField, gains: MixtureGains) -> tuple[tuple[float, float, float], float] | tuple[()]:
    """Return the contact that reduces the expected error most and its distance to the nearest one; () for none."""
    try:
        (contact,) = suggest(field, 1).contacts
    except FitError:
        # All points of the object are contacts already.
        return ()
    distance = float((gains.contacts - contact).norm(dim=1).min())
    if distance > float((gains.contacts.amax(0) - gains.contacts.amin(0)).norm()):
        # The points are in another unit or frame than the contacts.
        return ()
    x, y, z = contact.tolist()
    return (x, y, z), distance


def _error(field: SoundField, sounds: Float[Tensor, "contacts samples"], train: Impacts) -> float:
    """Return the relative STFT error, over all contacts together."""
    sizes, hops, _ = field.origin.config.resolutions(train.sample_rate)
    target = spectral_target(train.sounds.float(), fft_sizes=sizes, hops=hops)
    return float(spectral_loss(sounds.float(), target)) / len(sizes)
