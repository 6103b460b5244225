"""How well a field predicts its own contacts from each other, where it should be recorded next, and its residual."""

import math
from dataclasses import asdict, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.next_contacts import suggest
from avmsf.field.sound_field import FieldQuality, SoundField
from avmsf.modal.residual_noise import Residual

MIN_PLACES = 4
"""Places below which leaving one out says nothing of the field of all."""
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Spread shares that are tried."""


def with_quality(field: SoundField, train: Impacts, *, advise: bool = True) -> SoundField:
    """Return a field with the residual and spread share that predict its own contacts best, and its quality reported.

    The residual is the stationary noise of the field, or the mean of what the three nearest recordings have in addition
    to their modes. By the error at contacts left out; of the shares the smallest within one standard error of the best,
    since fewer contacts leave more spread. `train` holds the recordings that the gain model uses, row for row. A field
    of fewer than `MIN_PLACES` places keeps its noise, a share of zero, and has no quality. `advise`: whether to name
    the contact to record next, one of the field's points; not if these are not on the object.
    """
    gains = field.gain_field
    if not isinstance(gains, MixtureGains) or gains.place_count < MIN_PLACES:
        return field
    samples, places = train.sounds.shape[1], gains.places
    fitted = field.modal_sounds(Gains(gains.values.real.float(), gains.values.imag.float()), samples)
    recordings = (train.sounds - fitted).float()
    rows, signs = gains.nearest(gains.training, places)
    neighbors = (train.sounds[rows] * signs[..., None]).float()
    residuals = {"noise": field.noise(samples)}
    if field.origin.config.residual:
        residuals["recordings"] = (recordings[rows] * signs[..., None]).mean(1)
    modes = [field.modal_sounds(gains.left_out_estimate(share), samples) for share in SHARES]
    error = _Error(field, train, places)
    errors = {kind: torch.stack([error(each + added) for each in modes]) for kind, added in residuals.items()}
    best = min(errors, key=lambda kind: float(errors[kind].mean(1).min()))
    if best == "recordings":
        field = replace(field, residual=Residual(field.residual.magnitude, recordings))
    chosen = smallest_within_error(errors[best])
    field = replace(field, gain_field=replace(gains, spread_share=SHARES[chosen]))
    reached = {kind: float(each[chosen].mean()) for kind, each in errors.items()}
    contact, distance = (_next(field, gains) if advise else ()) or (None, None)
    nearest, averaged = error(neighbors[:, 0]), error(neighbors.mean(1))
    simple = min(nearest, averaged, key=lambda each: float(each.mean()))
    deviation = float((errors[best][chosen] - simple).std()) / math.sqrt(len(simple))
    found = FieldQuality(
        gains.place_count, reached[best], float(averaged.mean()), contact, distance, deviation, float(nearest.mean())
    )
    report = {**field.origin.report, "quality": asdict(found), "residual": reached}
    return replace(field, origin=replace(field.origin, report=report))


def smallest_within_error(errors: Float[Tensor, "choices places"]) -> int:
    """Return the first choice whose mean error is within one standard error, of the difference, of the least one."""
    more = errors - errors[errors.mean(1).argmin()]
    allowed = more.std(1) / math.sqrt(errors.shape[1])
    return int((more.mean(1) <= allowed).double().argmax())


def _next(field: SoundField, gains: MixtureGains) -> tuple[tuple[float, float, float], float] | tuple[()]:
    """Return the contact that reduces the expected error most and its distance to the nearest one; () for none."""
    try:
        (contact,) = suggest(field, 1, progress=False).contacts
    except FitError:
        # All points of the object are contacts already.
        return ()
    distance = float((gains.contacts - contact).norm(dim=1).min())
    if distance > float((gains.contacts.amax(0) - gains.contacts.amin(0)).norm()):
        # The points are in another unit or frame than the contacts.
        return ()
    x, y, z = contact.tolist()
    return (x, y, z), distance


class _Error:
    """Relative STFT errors of sounds at the contacts of recordings, averaged over the recordings of each place.

    Repeats at one place are not independent: they share what the other places predict of it.
    """

    def __init__(self, field: SoundField, train: Impacts, places: Int[Tensor, " contacts"]) -> None:
        sizes, hops, _ = field.origin.config.resolutions(train.sample_rate)
        self.targets = [spectral_target(each[None], fft_sizes=sizes, hops=hops) for each in train.sounds.float()]
        loud = torch.tensor([[float(norm.sum()) for norm in each.norms] for each in self.targets])
        self.weight = (loud / loud.mean(0).clamp_min(torch.finfo(loud.dtype).tiny)).mean(1) / len(sizes)
        self.places, self.repeats = places, torch.bincount(places)

    def __call__(self, sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, " places"]:
        pairs = zip(sounds.float(), self.targets, strict=True)
        errors = self.weight * torch.stack([spectral_loss(each[None], target) for each, target in pairs])
        return errors.new_zeros(len(self.repeats)).index_add(0, self.places, errors) / self.repeats
