"""A field's residual noise: its level, trained as in the paper and measured, and Gaussian or of low fluctuation."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Impacts, read_capture
from avmsf.evaluation.scores import score
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.simulate.recipe import SIM20, named_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.field import QUICK_LOOK, filled_estimator
from benchmarks.material import STRUCK, capture_in_place, example_capture, surface_features
from benchmarks.report import Options, Report, Table, log

RATES = {"trained": 0.1, "measured": 0.0}
"""Rate at which the fit trains the residual's magnitudes; 0 measures them. Both fields render Gaussian noise."""
STEADY = "low_fluctuation"
"""The field of measured magnitudes, which renders noise of low fluctuation."""
TAIL = 0.2
"""Part of a sound, its end, in which levels are compared."""
LOWEST_HERTZ = 20.0
CONVENTIONS = (
    "tail_db: level of rendered over recorded sounds at held-out contacts in the last fifth of the sound, above 20 Hz, "
    "dB; median over contacts, then over objects. trained: the residual's magnitudes follow the spectral loss, as in "
    "the paper; measured: they are fitted to the log spectra after training (the default). Both render Gaussian noise; "
    "low_fluctuation: as measured, rendered with noise of low fluctuation (the default).",
    "error: relative STFT error; l1_log: log-mel distance, nepers; means over held-out contacts, then objects. "
    "Dampings are shared; seed 0. mug: the built-in example, 12 of 16 contacts to train on; plate: 4 mm, 20 of 100; "
    "aircraft: aircraft_response, 15 of 74, first contact 0; sim20: the 20 simulated objects, 8 of 40 each, sounds "
    "scaled so that the loudest of an object peaks at one. Gains: all kernel families; on the plate no elastic one.",
)


@dataclass(frozen=True, eq=False)
class _Case:
    name: str
    train: Impacts
    test: Impacts
    features: FeatureField
    gains: MixtureEstimator


def measure(options: Options) -> Report:
    """Return levels and errors of the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in (*RATES, STEADY)}
        for case in PARTS[part](options):
            for name, judged in _judged(case, options):
                rows[name].append(judged)
                tail, error, l1_log = judged
                log(f"residual.{part}: {case.name}, {name}: tail {tail:.2f} dB, error {error:.4f}, l1_log {l1_log:.4f}")
        table: list[list[str | float]] = []
        figures: dict[str, float] = {}
        for name, found in rows.items():
            columns = torch.tensor(found, dtype=torch.float64)
            tail, error, l1_log = float(columns[:, 0].median()), *columns[:, 1:].mean(0).tolist()
            table.append([name, tail, error, l1_log])
            keys = [f"residual.{part}.{name}.{key}" for key in ("tail_db", "error", "l1_log")]
            figures |= dict(zip(keys, (tail, error, l1_log), strict=True))
        report += Report(tables=(Table(part, ("residual", "tail_db", "error", "l1_log"), table),), figures=figures)
    return report


def _judged(case: _Case, options: Options) -> Iterator[tuple[str, tuple[float, float, float]]]:
    """Yield the name of each residual with the tail's level in dB, the relative STFT error and L1-log."""
    config = QUICK_LOOK if options.quick_look else FitConfig(damping="shared")
    modes = extract_modes(case.train)
    test = modes.aligned(case.test)
    for name, rate in RATES.items():
        rated = replace(config, noise_rate=rate, residual_noise="gaussian")
        field = fit(case.train, case.features, modes, rated, gains=case.gains)
        yield name, _scores(field, test)
    steady = replace(field.origin, config=replace(field.origin.config, residual_noise="low-fluctuation"))
    yield STEADY, _scores(replace(field, origin=steady), test)


def _scores(field: SoundField, test: Impacts) -> tuple[float, float, float]:
    sounds = field.render(test.contacts, directions=test.directions)
    levels = [_tail_power(each, test.sample_rate) for each in (sounds, test.sounds)]
    means = score(sounds, test).mean()
    return float((10 * torch.log10(levels[0] / levels[1])).median()), means["relative_stft"], means["l1_log"]


def _tail_power(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> Float[Tensor, " contacts"]:
    samples = sounds.shape[1]
    spectra = torch.fft.rfft(sounds.double())
    spectra[:, torch.fft.rfftfreq(samples, 1 / sample_rate) < LOWEST_HERTZ] = 0
    return torch.fft.irfft(spectra, n=samples)[:, -round(TAIL * samples) :].square().mean(1)


def _mug(options: Options) -> Iterator[_Case]:
    capture = example_capture()
    assert capture.surface is not None
    train, test = split(capture.impacts, 12)
    bodies = None if options.quick_look else candidate_bodies(capture.surface)
    yield _Case("mug", train, test, surface_features(capture), MixtureEstimator(bodies=bodies))


def _plate(options: Options) -> Iterator[_Case]:
    count, seconds = (20, 0.25) if options.quick_look else (100, 3.0)
    train, test = split(STRUCK.strikes(count, seconds=seconds), 0.2)
    yield _Case("plate", train, test, STRUCK.features(), MixtureEstimator())


def _aircraft(options: Options) -> Iterator[_Case]:
    capture = capture_in_place("aircraft_response")
    assert capture.surface is not None
    train, test = split(capture.impacts, 15)
    gains = MixtureEstimator() if options.quick_look else filled_estimator(capture.surface, options)
    yield _Case("aircraft", train, test, surface_features(capture), gains)


def _sim20(options: Options) -> Iterator[_Case]:
    for name in tuple(SIM20)[: 1 if options.quick_look else None]:
        if options.sim20 is None:
            capture = simulate_object(named_recipe(name), name=name).capture
        else:
            capture = read_capture(options.sim20 / name)
        assert capture.surface is not None
        full_scale = capture.impacts.sounds / capture.impacts.sounds.abs().max()
        train, test = split(replace(capture.impacts, sounds=full_scale), 8)
        bodies = None if options.quick_look else candidate_bodies(capture.surface, impacts=train)
        yield _Case(name, train, test, surface_features(capture), MixtureEstimator(bodies=bodies))


PARTS: dict[str, Callable[[Options], Iterator[_Case]]] = {
    "mug": _mug,
    "plate": _plate,
    "aircraft": _aircraft,
    "sim20": _sim20,
}
