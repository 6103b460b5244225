"""A field's residual noise: its level, trained as in the paper and measured, and Gaussian or of low fluctuation."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.evaluation.scores import score
from avmsf.evaluation.simple_methods import MeanWaveform, NearestRecording
from avmsf.evaluation.splits import split
from avmsf.evaluation.task import Sounds
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.data import along_phase
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.gains.model import Gains
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.simulate.recipe import SIM20
from benchmarks import objects
from benchmarks.records import Measurement, Record, Settings, means, records

RATES = {"trained": 0.1, "measured": 0.0}
"""Rate at which the fit trains the residual's magnitudes; 0 measures them. Both fields render Gaussian noise."""
TAIL = 0.2
"""Part of a sound, its end, in which levels are compared."""
LOWEST_HERTZ = 20.0
_Case = tuple[Impacts, Impacts, FeatureField, MixtureEstimator]


def _measure(settings: Settings, part: str) -> Iterator[Record]:
    """Level of rendered over recorded sounds, and errors, at held-out contacts, by the residual noise and its level.

    tail_db: in the last fifth of the sound, above 20 Hz; medians over contacts, then over objects. error: relative STFT
    error; l1_log: log-mel distance, nepers; means over contacts, then objects. trained: the residual's magnitudes
    follow the spectral loss, as in the paper; measured: they are fitted to the log spectra after training (the
    default). Both render Gaussian noise; low_fluctuation: as measured, rendered with noise of low fluctuation (the
    default). known_force: the same with each impact's force given, beneath which the background has its level;
    own_gains, own_gains_known_force: the same two with each recording's own least-squares gains; nearest, knn: the
    nearest recording, and the mean of three. Dampings are shared; all kernel families, on the plate no elastic
    one.
    """
    rows: dict[str, list[dict[str, float]]] = {}
    for name, case in _cases(part, settings):
        for residual, values in _compared(case, settings):
            rows.setdefault(residual, []).append(values)
            yield from records(values, group=residual, object=name)
    for residual, found in rows.items() if part == "sim20" else ():
        levels = torch.tensor([each["tail_db"] for each in found], dtype=torch.float64)
        yield from records(means(found) | {"tail_db": float(levels.median())}, group=f"{residual}.all")


def _compared(case: _Case, settings: Settings) -> Iterator[tuple[str, dict[str, float]]]:
    train, test, features, gains = case
    config = objects.QUICK_FIT if settings.quick else FitConfig(damping="shared")
    modes = extract_modes(train)
    test = modes.aligned(test)
    for name, rate in RATES.items():
        rated = replace(config, noise_rate=rate, residual_noise="gaussian")
        field = fit(train, features, modes, rated, gains=gains)
        yield name, _scores(_rendered(field, test), test)
    steady = replace(field.origin, config=replace(field.origin.config, residual_noise="low-fluctuation"))
    field = replace(field, origin=steady)
    yield "low_fluctuation", _scores(_rendered(field, test), test)
    own = along_phase(fit_gains(test.sounds, field.bank, sample_rate=test.sample_rate), field.phase)
    sounds, background = field.modal_sounds(Gains(own.to(torch.complex64)), field.samples), field.noise()
    yield "own_gains", _scores(sounds + background, test)
    if test.forces is not None:
        yield "known_force", _scores(_rendered(field, test, test.forces) / test.forces[:, None], test)
        relative = test.forces[:, None] / (field.residual.force or 1.0)
        yield "own_gains_known_force", _scores(sounds + background / relative, test)
    aligned = modes.aligned(train)
    yield "nearest", _scores(NearestRecording(aligned).render(test.contacts), test)
    yield "knn", _scores(MeanWaveform(aligned).render(test.contacts), test)


def _rendered(field: SoundField, test: Impacts, forces: Float[Tensor, " contacts"] | None = None) -> Sounds:
    return field.render(test.contacts, directions=test.directions, forces=forces)


def _scores(sounds: Sounds, test: Impacts) -> dict[str, float]:
    levels = [_tail_power(each, test.sample_rate) for each in (sounds, test.sounds)]
    found = score(sounds, test).mean()
    level = float((10 * torch.log10(levels[0] / levels[1])).median())
    others = {name: found[name] for name in ("l1", "l1_log", "envelope")}
    return {"tail_db": level, "error": found["relative_stft"], **others}


def _tail_power(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> Float[Tensor, " contacts"]:
    samples = sounds.shape[1]
    spectra = torch.fft.rfft(sounds.double())
    spectra[:, torch.fft.rfftfreq(samples, 1 / sample_rate) < LOWEST_HERTZ] = 0
    return torch.fft.irfft(spectra, n=samples)[:, -round(TAIL * samples) :].square().mean(1)


def _cases(part: str, settings: Settings) -> Iterator[tuple[str, _Case]]:
    """Yield the objects of a part: training and held-out recordings, features and gain model."""
    if part == "plate":
        count, seconds = (20, 0.25) if settings.quick else (100, 3.0)
        train, test = split(objects.STRUCK.strikes(count, seconds=seconds), 0.2)
        yield part, (train, test, objects.STRUCK.features(), MixtureEstimator())
        return
    for name in settings.objects or settings.some(tuple(SIM20)) if part == "sim20" else (part,):
        if part in ("aircraft", "strikes"):
            folder = {"aircraft": "aircraft_response", "strikes": "aircraft"}[part]
            capture, count = objects.measured(folder, objects.settings_of(folder)), 15
        elif part == "mug":
            capture, count = objects.example_capture(), 12
        else:
            capture, count = objects.simulated(name, settings)[0], 8
            full_scale = capture.impacts.sounds / capture.impacts.sounds.abs().max()
            capture = replace(capture, impacts=replace(capture.impacts, sounds=full_scale))
        train, test = split(capture.impacts, count)
        gains, surface = MixtureEstimator(), objects.surface_of(capture)
        if part in ("aircraft", "strikes") and not settings.quick:
            gains = objects.solid_estimator(surface, settings)
        elif not settings.quick:
            impacts = train if part == "sim20" else None
            gains = MixtureEstimator(bodies=candidate_bodies(surface, impacts=impacts))
        yield name, (train, test, objects.features_of(capture), gains)


PARTS: dict[str, Measurement] = {
    part: partial(_measure, part=part) for part in ("mug", "plate", "aircraft", "strikes", "sim20")
}
