"""Gain models: held-out errors of the mixture, its families and simple methods, on measured and simulated objects."""

import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from avmsf.capture import Impacts
from avmsf.errors import CaptureWarning
from avmsf.evaluation.modal_metrics import truth_at, truth_from_first_sample
from avmsf.evaluation.objects import roughened
from avmsf.evaluation.scores import evaluate, score
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.field.config import FitConfig
from avmsf.field.gains.data import GainData
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import FAMILIES, MixtureEstimator
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.points import farthest_points
from avmsf.localization.locator import Locator
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.modal.synthesis import synthesize
from avmsf.pipeline.cloud_shape import shape_of_cloud
from avmsf.reconstruction import ObjectShape
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.recipe import SET, SETS
from benchmarks.ablation import ablation, outliers, supports
from benchmarks.material import MissingDataError, example_capture
from benchmarks.report import Options, Report, Table, log
from benchmarks.splitcases import COUNTS, ROUGH, SplitCase, bodies_of, measured, simulated, split_case, splits_of
from benchmarks.surface import views_and_gaussians

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
        capture = measured(name)
        bodies = None if capture.surface is None else bodies_of(capture.surface, options)
        for count in counts[:1] if options.quick_look else counts:
            found: dict[str, list[float]] = defaultdict(list)
            for case in splits_of(capture, count, bodies, options):
                single, inside = _errors(case, options)
                for method, error in single.items():
                    found[method].append(error)
                simple = min(single[method] for method in SIMPLE)
                found["best simple"].append(simple)
                found["coverage"].append(inside)
                ratios.append(single[MIXTURE] / simple)
                bests.append(single[MIXTURE] / min(single.values()))
            means = {method: float(np.mean(each)) for method, each in found.items()}
            log(f"{name} {count}: {means}")
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
    needed = {Elastic.kind: case.bodies, Symmetric.kind: case.symmetries}
    for kind in FAMILIES:
        if needed.get(kind, kind):
            alone = MixtureEstimator((kind,), case.bodies, symmetries=case.symmetries)
            single[kind] = case.error(case.fit(alone, quick=True))
    mixture = MixtureEstimator(bodies=case.bodies)
    single[UNREFINED] = case.error(case.fit(mixture, quick=True))
    field = case.fit(mixture, quick=options.quick_look)
    single[MIXTURE] = case.error(field)
    return single, case.coverage(field)


def _simulated(options: Options, condition: str = "", of: str = SET) -> Report:
    """Errors on a set of simulated objects, by what a condition says is known; on exact meshes with fewer contacts too.

    Contacts are farthest-point samples of 40, from the first.
    """
    rows: list[list[str | float]] = []
    with tempfile.TemporaryDirectory() as cache:
        for name in options.objects or tuple(SETS[of])[: 2 if options.quick_look else None]:
            capture, truth = simulated(name, options, Path(cache), tidy=condition == "tidy")
            assert capture.surface is not None
            surface: Surface | ObjectShape = capture.surface
            if condition == "noisy":
                surface = roughened(capture.surface, ROUGH, seed=0)
            elif condition in {"photographs", "offset"}:
                surface = _photographed(name, options)
                capture = replace(capture, surface=surface.as_seen())
            if condition == "offset":
                capture = replace(capture, impacts=_moved(capture.impacts))
            bodies = bodies_of(surface, options)
            case, *fewer = (
                split_case(*split(capture.impacts, count), capture, bodies)
                for count in (_IMPACTS if not condition else _IMPACTS[:1])
            )
            errors = [each.error(each.fit(MixtureEstimator(bodies=bodies), quick=options.quick_look)) for each in fewer]
            rows.append([name, *_simulated_row(case, truth, options), *errors])
            log(f"{condition} {rows[-1]}")
    values = np.array([row[1:] for row in rows])
    ratios = slice(_ERRORS, _ERRORS + _RATIOS)
    means = values.mean(0)
    means[ratios] = np.exp(np.log(values[:, ratios]).mean(0))
    rows.append(["mean; of ratios the geometric mean", *map(float, means)])
    prefix = f"gains.{of.replace('-', '')}_{condition}".rstrip("_")
    columns = [*_KEYS, *(f"error_{count}" for count in _IMPACTS[1:])][: len(means)]
    keys = {f"{prefix}_{key}": float(value) for key, value in zip(columns, means, strict=True)}
    title = f"simulated objects, {of}, {_IMPACTS[0]} contacts, {_CONDITIONS[condition]}"
    return Report(tables=(Table(title, ("object", *columns), rows),), figures=keys)


def _photographed(name: str, options: Options) -> ObjectShape:
    """Return the shape of an object from its photographs alone."""
    if options.sim20 is None or options.clouds is None:
        raise MissingDataError("photographs: give --sim-20 and --clouds, folders of the objects and their Gaussians")
    views, cloud = views_and_gaussians(options.sim20 / name, options.clouds, quick=options.quick_look)
    return shape_of_cloud(cloud, views)


def _moved(impacts: Impacts) -> Impacts:
    """Return impacts with contacts 2 mm off, in random directions."""
    ways = torch.randn(impacts.contacts.shape, generator=torch.Generator().manual_seed(0))
    return replace(impacts, contacts=impacts.contacts + 0.002 * ways / ways.norm(dim=1, keepdim=True))


_CONDITIONS = {
    "": "exact meshes",
    "tidy": "exact meshes, recordings that need no alignment",
    "noisy": "meshes whose vertices are off by .3 % of the size (standard deviation, each axis)",
    "photographs": "shapes from 72 photographs",
    "offset": "shapes from 72 photographs, contacts 2 mm off in random directions",
}
_IMPACTS = (8, 4, 2, 1)
"""Training contacts of the simulated objects."""
_KEYS = ("error", "averaging", "modal", "l1", "l1_log", "envelope", "coverage", "located")
_ERRORS, _RATIOS = 3, 3
"""So many of the keys are errors; so many more are ratios to averaging."""


def _simulated_row(case: SplitCase, truth: Truth, options: Options) -> list[float]:
    """Return the figures of one simulated object."""
    field = case.fit(MixtureEstimator(bodies=case.bodies), quick=options.quick_look)
    scores, averaged = evaluate(field, case.test).mean(), evaluate(MeanWaveform(case.train), case.test).mean()
    row = [scores["relative_stft"], averaged["relative_stft"], _modal_error(field, case.test, truth)]
    row += [scores[metric] / averaged[metric] for metric in ("l1", "l1_log", "envelope")]
    return [*row, case.coverage(field), _located(field, case.test)]


def _located(field: SoundField, test: Impacts) -> float:
    """Return the median distance of held-out contacts from where their recordings are located, over the diagonal."""
    points = field.gain_field.points
    size = float((points.amax(0) - points.amin(0)).norm())
    locator = Locator.of(field, points=points[farthest_points(points, min(_PLACES, len(points)))])
    places = torch.stack([locator.locate(sound).position for sound in test.sounds])
    return float((places - test.contacts).norm(dim=1).median()) / size


def _speed(options: Options) -> Report:
    """Seconds of the fit of the built-in example with its elastic modes at hand, and of the gains of a large case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        capture = example_capture()
    assert capture.surface is not None
    bodies = bodies_of(capture.surface, options)
    train, test = split(capture.impacts, 12)
    case = split_case(train, test, capture, bodies)
    start = time.perf_counter()
    case.fit(MixtureEstimator(bodies=bodies), quick=options.quick_look)
    seconds = {"example_fit_s": time.perf_counter() - start}
    contacts, modes = (20, 12) if options.quick_look else (200, 128)
    large = _large_case(bodies.bodies[0].elastic, contacts, modes)
    start = time.perf_counter()
    MixtureEstimator(bodies=bodies).solve(large)
    seconds["large_fit_s"] = time.perf_counter() - start
    rows: list[list[str | float]] = [
        [f"fit of the example, 12 contacts, {len(case.modes.bank)} modes", seconds["example_fit_s"]]
    ]
    rows.append([f"gain model of {contacts} contacts and {modes} modes, bodies and outliers", seconds["large_fit_s"]])
    figures = {f"gains.{key}": value for key, value in seconds.items()}
    return Report(tables=(Table("seconds with elastic modes at hand", ("work", "seconds"), rows),), figures=figures)


def _large_case(elastic: ElasticModes, contacts: int, modes: int) -> GainData:
    """Return gains of random mixtures of neighboring mode shapes at random places of a body, with 3 % of noise."""
    generator = torch.Generator().manual_seed(0)
    points = elastic.nodes[torch.randperm(len(elastic.nodes), generator=generator)[:contacts]]
    directions = -elastic.normals(points)
    frequency = torch.linspace(float(elastic.frequency[0]), float(elastic.frequency[-1]), modes, dtype=torch.float64)
    near = torch.exp(-0.5 * ((elastic.frequency[:, None] - frequency) / (0.05 * frequency)).square())
    mixed = near * torch.randn(near.shape, generator=generator, dtype=torch.float64)
    gains = elastic.gains(points, directions) @ mixed
    gains = gains + 0.03 * gains.std(0) * torch.randn(gains.shape, generator=generator, dtype=torch.float64)
    impacts = Impacts(
        contacts=points.float(), sounds=torch.zeros(contacts, 4410), sample_rate=44100.0,
        names=tuple(f"{row:03d}" for row in range(contacts)), directions=directions.float(),
    )  # fmt: skip
    bank = ModalBank(frequency, torch.full_like(frequency, 20.0))
    ahead = 0.02 * gains * torch.randn(gains.shape, generator=generator, dtype=torch.float64)
    found = Extraction(bank, torch.complex(gains, ahead), Residual(torch.zeros(1025)))
    phase = torch.zeros(modes, dtype=torch.float64)
    return GainData(impacts, FeatureField.from_points(elastic.nodes.float()), found, phase, gains, FitConfig())


def _modal_error(field: SoundField, test: Impacts, truth: Truth) -> float:
    """Return the error of the field's modes against the true ones, both without noise."""
    true = truth_from_first_sample(truth_at(truth, test.names), test)
    clean = synthesize(
        true.gains.to(torch.complex64),
        true.frequency,
        true.damping,
        samples=test.sounds.shape[1],
        sample_rate=test.sample_rate,
    )
    silent = replace(field, residual=Residual(torch.zeros_like(field.residual.magnitude)))
    made = silent.render(test.contacts, directions=test.directions, samples=test.sounds.shape[1])
    return score(made, replace(test, sounds=clean)).mean()["relative_stft"]


_PLACES = 1000
"""Points of the surface among which recordings are located."""


PARTS: dict[str, Callable[[Options], Report]] = {
    "captures": _captures,
    **{f"sim20-{name}".rstrip("-"): partial(_simulated, condition=name) for name in _CONDITIONS},
    "held-out": partial(_simulated, of="held-out"),
    "held-out-photographs": partial(_simulated, condition="photographs", of="held-out"),
    "ablation": ablation,
    "outliers": outliers,
    "supports": supports,
    "speed": _speed,
}
