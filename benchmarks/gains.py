"""Gain models: held-out errors of the mixture, its families and simple methods, on measured and simulated objects."""

import tempfile
import warnings
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from avmsf.bench.baselines import MeanWaveform
from avmsf.bench.evaluation import evaluate, score, split
from avmsf.bench.knowntruth import truth_at, truth_from_first_sample
from avmsf.capture import Capture, CaptureSettings, CaptureWarning, Impacts, read_capture
from avmsf.field.config import FitConfig
from avmsf.field.doubt import coverage
from avmsf.field.fit import fit
from avmsf.field.gains.bodies import CandidateBodies
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import FAMILIES, MixtureEstimator
from avmsf.field.recipes import along_phase
from avmsf.field.soundfield import SoundField
from avmsf.modal.extraction.extract import Extraction, extract
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.residual import Residual
from avmsf.modal.synthesis import synthesise
from avmsf.pipeline.bodies import BodyConfig, candidate_bodies
from avmsf.scene.features import FeatureField
from avmsf.simulate.sim20 import SIM20, sim20_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.truth import Truth, read_truth
from benchmarks.material import shared_data, surface_features
from benchmarks.report import Options, Report, Table, tell

STARTS = (0, 18, 37)
COUNTS = {"aircraft_response": (8, 15, 28), "ruler10": (5, 7), "tree43": (12, 20, 40)}
"""Training places of each measured capture."""
SIMPLE = {
    f"mean of {count}{' by direction' * by_direction}": partial(MeanWaveform, count=count, by_direction=by_direction)
    for by_direction in (False, True)
    for count in (1, 2, 3, 4)
}
"""Simple methods; the best of them in hindsight is what a field should never be much worse than."""
MIXTURE, UNREFINED = "mixture", "mixture, not refined"
CONVENTIONS = (
    "error: relative STFT error at held-out contacts, mean of farthest-point splits from contacts 0, 18 and 37, as far "
    "as there are so many; default settings. In brackets the worst split.",
    "families: the Gaussian process over the unstructured and this family alone, one end-to-end step; mixture, not "
    "refined: all families, one step; mixture: as `avmsf fit` has it.",
    "best simple: the mean waveform of 1 to 4 nearest recordings, by distance or by distance and direction, whichever "
    "is best on the held-out contacts of each split.",
)


@dataclass(frozen=True, eq=False)
class SplitCase:
    """One split of one object."""

    train: Impacts
    test: Impacts
    modes: Extraction
    features: FeatureField
    bodies: CandidateBodies | None

    def fit(self, estimator: MixtureEstimator, *, quick: bool) -> SoundField:
        """Return the field of an estimator, refined unless it should be quick."""
        steps = 1 if quick else FitConfig().steps
        config = FitConfig(warmup_steps=0, steps=steps)
        return fit(self.train, self.features, self.modes, config, gains=estimator)

    def error(self, field: SoundField) -> float:
        """Return the relative STFT error at the held-out contacts."""
        return evaluate(field, self.test).mean()["relative_stft"]


def measure(options: Options) -> Report:
    """Return the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _captures(options: Options) -> Report:
    """Errors on measured captures, and how many measured gains lie in intervals of 90 %."""
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    ratios: list[float] = []
    bests: list[float] = []
    for name, counts in COUNTS.items():
        capture = _read(name)
        bodies = None if capture.surface is None else _bodies(capture, options)
        for count in counts[:1] if options.quick_look else counts:
            found: dict[str, list[float]] = defaultdict(list)
            for case in _splits(capture, count, bodies, options):
                single, inside = _errors(case, options)
                for method, error in single.items():
                    found[method].append(error)
                simple = min(single[method] for method in SIMPLE)
                found["best simple"].append(simple)
                found["coverage"].append(inside)
                ratios.append(single[MIXTURE] / simple)
                bests.append(single[MIXTURE] / min(single.values()))
            means = {method: float(np.mean(each)) for method, each in found.items()}
            tell(f"{name} {count}: {means}")
            shown = ("mean of 3", "best simple", *FAMILIES, UNREFINED, MIXTURE)
            cells = [f"{means[each]:.3f} ({max(found[each]):.3f})" if each in means else "-" for each in shown]
            rows.append([f"{name}, {count} places", *cells, f"{means['coverage']:.2f}"])
            key = "aircraft" if name == "aircraft_response" else name
            figures |= {f"gains.{key}.{count}.{method}": error for method, error in means.items()}
    figures |= {"gains.worst_ratio_to_simple": max(ratios), "gains.mean_ratio_to_best": float(np.mean(bests))}
    columns = ("capture", "mean of 3", "best simple", *FAMILIES, UNREFINED, MIXTURE, "in 90 % intervals")
    return Report(tables=(Table("held-out error of gain models on measured captures", columns, rows),), figures=figures)


def _errors(case: SplitCase, options: Options) -> tuple[dict[str, float], float]:
    """Return each method's error, and the part of held-out gains within the mixture's intervals of 90 %."""
    single = {
        method: evaluate(make(case.train), case.test).mean()["relative_stft"]
        for method, make in SIMPLE.items()
        if make.keywords["count"] <= len(case.train)
    }
    for kind in FAMILIES:
        if kind != Elastic.kind or case.bodies is not None:
            single[kind] = case.error(case.fit(MixtureEstimator((kind,), case.bodies), quick=True))
    mixture = MixtureEstimator(bodies=case.bodies)
    single[UNREFINED] = case.error(case.fit(mixture, quick=True))
    field = case.fit(mixture, quick=options.quick_look)
    single[MIXTURE] = case.error(field)
    parts = along_phase(*fit_gains(case.test.sounds, field.bank, sample_rate=field.sample_rate), field.phase)
    return single, coverage(field, case.test.contacts, parts, directions=case.test.directions).by_energy


def _sim20(options: Options) -> Report:
    """Errors on the simulated objects with their meshes, 8 training contacts of 40."""
    rows: list[list[str | float]] = []
    names = tuple(SIM20)[:2] if options.quick_look else tuple(SIM20)
    ratios: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as cache:
        for name in names:
            capture, truth = _simulated(name, options, Path(cache))
            bodies = _bodies(capture, options, cache=Path(cache) / name)
            train, test = split(capture.impacts, fraction=0.2)
            case = _case(train, test, capture, bodies)
            field = case.fit(MixtureEstimator(bodies=bodies), quick=options.quick_look)
            scores = evaluate(field, case.test).mean()
            averaged = evaluate(MeanWaveform(case.train), case.test).mean()
            modal = _modal_error(field, case.test, truth)
            row = [scores["relative_stft"], averaged["relative_stft"], modal]
            row += [scores[metric] / averaged[metric] for metric in ("l1", "l1_log", "envelope")]
            rows.append([name, *row])
            for key, value in zip(("error", "averaging", "modal", "l1", "l1_log", "envelope"), row, strict=True):
                ratios[key].append(value)
            tell(f"{name}: {row}")
    means = [float(np.mean(ratios[key])) for key in ("error", "averaging", "modal")]
    means += [float(np.exp(np.mean(np.log(ratios[key])))) for key in ("l1", "l1_log", "envelope")]
    rows.append(["mean; of ratios the geometric mean", *means])
    columns = ("object", "error", "mean of 3", "modal error", "L1 over mean of 3", "L1-log", "ENV")
    keys = ("error", "averaging", "modal", "l1", "l1_log", "envelope")
    figures = {f"gains.sim20_{key}": value for key, value in zip(keys, means, strict=True)}
    return Report(tables=(Table("simulated objects, 8 contacts, exact meshes", columns, rows),), figures=figures)


def _modal_error(field: SoundField, test: Impacts, truth: Truth) -> float:
    """Return the error of the field's modes against the true ones, both without noise."""
    true = truth_from_first_sample(truth_at(truth, test.names), test)
    clean = synthesise(
        true.gains.float(),
        true.frequency,
        true.damping,
        samples=test.sounds.shape[1],
        sample_rate=test.sample_rate,
        quadrature=true.quadrature.float(),
    )
    silent = replace(field, residual=Residual(torch.zeros_like(field.residual.magnitude)))
    made = silent.render(test.contacts, directions=test.directions, samples=test.sounds.shape[1])
    return score(made, replace(test, sounds=clean)).mean()["relative_stft"]


def _splits(capture: Capture, count: int, bodies: CandidateBodies | None, options: Options) -> Iterator[SplitCase]:
    """Yield the splits of a capture."""
    starts = [start for start in STARTS if start < len(capture.impacts)]
    for start in starts[:1] if options.quick_look else starts:
        yield _case(*split(capture.impacts, count=count, start=start), capture, bodies)


def _case(train: Impacts, test: Impacts, capture: Capture, bodies: CandidateBodies | None) -> SplitCase:
    modes = extract(train)
    contacts = capture.impacts.contacts
    features = FeatureField.from_contacts(contacts) if capture.surface is None else surface_features(capture)
    return SplitCase(modes.aligned(train), modes.aligned(test), modes, features, bodies)


def _bodies(capture: Capture, options: Options, *, cache: Path | None = None) -> CandidateBodies:
    config = BodyConfig(shapes=12, freedoms=3000) if options.quick_look else BodyConfig()
    assert capture.surface is not None
    return candidate_bodies(capture.surface, config, cache=cache, tell=tell)


def _read(name: str) -> Capture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        return read_capture(shared_data() / name, CaptureSettings())


def _simulated(name: str, options: Options, cache: Path) -> tuple[Capture, Truth]:
    """Return an object of the set and its truth, from the folder or simulated now."""
    if options.sim20 is not None:
        return read_capture(options.sim20 / name), read_truth(options.sim20 / name)
    made = simulate_object(sim20_recipe(name), name=name, cache=cache)
    return made.capture, made.truth


PARTS = {"captures": _captures, "sim20": _sim20}
