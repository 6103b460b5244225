"""From recordings, features and modes to a sound field."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

import torch

from avmsf._utils.caching import content_digest, source_digest
from avmsf._utils.device import TRAINABLE, usable_device
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import FitError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.gains.data import GainData, gain_data
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.gains.mixture_gains import NEIGHBORS, MixtureGains
from avmsf.field.gains.model import Gains
from avmsf.field.next_contacts import suggest
from avmsf.field.quality import FieldQuality, PlaceErrors, smallest_within_error
from avmsf.field.sound_field import SUPPORTING, Origin, SoundField
from avmsf.field.training import GainEstimator, Progress, Trainer
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.residual_noise import Residual, estimate_residual, missing_background

_MIN_PLACES = 4
"""Places below which leaving one out says nothing of the field of all."""
_SPREAD_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Spread shares that are tried."""


@torch.enable_grad()
def fit(
    train: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig | None = None,
    *,
    gains: GainEstimator | None = None,
    capture: str = "",
    settings: CaptureSettings | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    device: torch.device | str | None = None,
    supporting: Sequence[int] | None = None,
) -> SoundField:
    """Fit a sound field to recordings (paper, section 3.5).

    `modes` as extracted from `train`, or `random_modes` where there is no warm-up. `gains` fits the gain model; the
    default is the Gaussian process without elastic mode shapes (`MixtureEstimator`), since the object's shape is not
    known here. `settings` are the capture's; the field stores them, and recordings to be located are read by them. What
    the config leaves open is chosen on held-out training contacts, then the field is fitted to all. With `checkpoint`,
    the state is saved there during the fit, on interruption and at the end, and a fit of the same arguments continues
    from it to the same result; delete the file once the field is saved. The network and the spectral loss are trained
    on `device`, by default a CUDA GPU where there is one, with the same result up to rounding; clusters, the Gaussian
    process and the field are on the CPU. `supporting` are the rows of `modes` that are not modes of the object, for
    `SoundField.is_mode`. Raises `FitError` for arguments that do not fit together, a fit that diverges
    and a device that cannot be used, `FieldFileError` for a checkpoint of another fit.
    """
    config = FitConfig() if config is None else config
    settings = CaptureSettings() if settings is None else settings
    if train.before is not None and bool(train.before.isnan().all()):
        # Files that start with their impacts were not cut, and others are to be read alike.
        settings = replace(settings, align=False)
    data = gain_data(train, features, modes, config)
    train = data.train
    estimator = MixtureEstimator() if gains is None else gains
    trainer = Trainer(
        {"input, configuration or version": fingerprint(data, estimator)},
        checkpoint=checkpoint,
        progress=progress,
        device=usable_device(device, raising=FitError, kinds=TRAINABLE),
    )
    fitted = estimator.fit(data, trainer)
    order = fitted.run.order
    report = {"gain_model": estimator.name, **fitted.report}
    if modes.shifts is not None:
        report["frequency_shift"] = modes.shifts.relative
    if supporting is not None:
        report[SUPPORTING] = [row for row, found in enumerate(order.tolist()) if found in supporting]
    field = SoundField(
        fitted.run.trained,
        fitted.model,
        data.phase[order],
        Residual(fitted.run.residual.magnitude.detach().clone()),
        train.sample_rate,
        train.sounds.shape[1],
        Origin(capture, train.names, train.forces is not None, config, report, settings),
        modes.alignment,
    )
    return _with_quality(_with_noise(field, fitted.train), fitted.train, advise=features.on_surface)


def fingerprint(data: GainData, estimator: GainEstimator) -> str:
    """Return a digest of all that decides a fit's result, this package's version and code among it."""
    train, modes = data.train, data.modes
    words = [version("avmsf"), source_digest("avmsf.field.fit"), asdict(data.config), estimator.name]
    words += [estimator.digest(), train.digest(), data.features.digest()]
    # Phases, and without a warm-up how strong the modes are, are those of the extraction.
    return content_digest(words, modes.bank.frequency, modes.bank.damping, modes.residual.magnitude, modes.gains)


def _with_noise(field: SoundField, train: Impacts) -> SoundField:
    """Return a field with the background that its modes leave of the recordings, unless noise is trained or off."""
    config, bins = field.origin.config, len(field.residual.magnitude)
    if not config.residual or config.noise_rate or not config.steps:
        return field
    modes = field.render(train.contacts, directions=train.directions, noise=False)
    forces = (torch.ones(len(train)) if train.forces is None else train.forces).to(train.sounds)
    # In recordings that are not divided by their forces, the background has one level.
    average = float(forces.log().mean().exp())
    relative = (forces / average)[:, None]
    found = estimate_residual(relative * train.sounds, relative * modes, bins=bins)
    return replace(field, residual=replace(found, force=average))


def _with_quality(field: SoundField, train: Impacts, *, advise: bool) -> SoundField:
    """Return a field with the residual and spread share that predict its own contacts best, and its quality."""
    gains = field.gain_field
    if not isinstance(gains, MixtureGains) or gains.place_count < _MIN_PLACES:
        return field
    samples, places = train.sounds.shape[1], gains.places
    fitted = field.modal_sounds(Gains(gains.values.to(torch.complex64)), samples)
    recordings = (train.sounds - fitted).float()
    rows, signs = gains.nearest(gains.training, places)
    neighbors = (train.sounds[rows] * signs[..., None]).float()
    residuals = {"noise": field.noise(samples)}
    if field.origin.config.residual:
        residuals["recordings"] = (recordings[rows] * signs[..., None]).mean(1)
        if field.residual.force is not None:
            residuals["recordings"] += missing_background(torch.ones(()), NEIGHBORS) * residuals["noise"]
    modes = [field.modal_sounds(gains.left_out_estimate(share), samples) for share in _SPREAD_SHARES]
    error = PlaceErrors(train, places, field.origin.config)
    errors = {kind: torch.stack([error(each + added) for each in modes]) for kind, added in residuals.items()}
    best = min(errors, key=lambda kind: float(errors[kind].mean(1).min()))
    if best == "recordings":
        field = replace(field, residual=replace(field.residual, recordings=recordings))
    # Fewer contacts leave more spread.
    chosen = smallest_within_error(errors[best])
    field = replace(field, gain_field=replace(gains, spread_share=_SPREAD_SHARES[chosen]))
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
