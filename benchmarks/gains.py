"""Gain models: held-out errors of the mixture, its families and simple methods, on measured and simulated objects."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from avmsf.capture import Impacts
from avmsf.evaluation.modal_metrics import truth_at, truth_from_first_sample
from avmsf.evaluation.scores import evaluate, score
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.estimator import FAMILIES, MixtureEstimator
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.sound_field import SoundField
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.locator import Locator
from avmsf.mesh import Surface
from avmsf.mesh.points import farthest_points
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import synthesize
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.scene import shape_of_cloud
from avmsf.reconstruction import ObjectShape
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.recipe import ABLATED, SET
from benchmarks import objects
from benchmarks.ablation import ablation, free, outliers, supports
from benchmarks.processes import timed
from benchmarks.records import Measurement, Record, Settings, means, records

SIMPLE = {
    f"mean of {count}{' by direction' * by_direction}": partial(MeanWaveform, count=count, by_direction=by_direction)
    for by_direction in (False, True)
    for count in (1, 2, 3, 4)
}
"""Simple methods; the best of them in hindsight is what a field should never be much worse than."""
MIXTURE, UNREFINED = "mixture", "mixture, not refined"
_IMPACTS = (8, 4, 2, 1)
"""Training contacts of the simulated objects."""
_SETS = {"sim20": SET, "held-out": "held-out", "scans": "scans"}
"""Sets of simulated objects by the names of their parts."""
_BESIDE = ("coverage", "own", "held", "shifting")
"""What is told of the mixture beside its error."""
_SHIFTS = {"none": {}, "sensor": {"sensor": 0.0005}, "warming": {"warming": 0.002}}
_POINTS = 1000
"""Points of the surface among which recordings are located."""


def _captures(settings: Settings) -> Iterator[Record]:
    """Relative STFT error at held-out contacts, mean of farthest-point splits from contacts 0, 18 and 37.

    families: the Gaussian process over the unstructured and this family alone, one end-to-end step; mixture, not
    refined: all families, one step; mixture: as `avmsf fit` has it. best simple: the mean waveform of 1 to 4 nearest
    recordings, by distance or by distance and direction, whichever is best on the held-out contacts of each split.
    coverage: part of the held-out gains, by energy, in their intervals of 90 %. own: as in the part drift,
    without stretching. held, shifting: part of the splits in which the object is taken for held, its modes for
    shifting. worst: of the splits.
    """
    to_simple, to_best = [], []
    for name, counts in objects.COUNTS.items():
        capture = objects.measured(name)
        bodies = None if capture.surface is None else objects.bodies_of(capture.surface, settings)
        for count in settings.some(counts):
            runs = [_errors(case, settings) for case in objects.splits_of(capture, count, bodies, settings)]
            for run in runs:
                run["best simple"] = min(run[method] for method in SIMPLE if method in run)
                to_simple.append(run[MIXTURE] / run["best simple"])
                to_best.append(run[MIXTURE] / min(value for key, value in run.items() if key not in _BESIDE))
            yield from records(means(runs), group=str(count), object=name)
            shown = ("mean of 3", "best simple", *FAMILIES, UNREFINED, MIXTURE)
            worst = {key: max(run[key] for run in runs) for key in shown if key in runs[0]}
            yield from records(worst, group=f"{count}.worst", object=name)
    yield from records({"worst_ratio_to_simple": max(to_simple), "mean_ratio_to_best": float(np.mean(to_best))})


def _errors(case: objects.SplitCase, settings: Settings) -> dict[str, float]:
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
    field = case.fit(mixture, quick=settings.quick)
    report = field.origin.report
    return single | {
        MIXTURE: case.error(field),
        "coverage": case.coverage(field)[1],
        "own": _own_error(field, case.test),
        "held": float(case.bodies is not None and report["bodies"][0]["support"] != "free"),
        "shifting": float("frequency_shift" in report),
    }


def _simulated(settings: Settings, condition: str = "", of: str = SET) -> Iterator[Record]:
    """Errors on simulated objects, 8 training contacts; on exact meshes with fewer contacts too.

    Contacts are farthest-point samples of 40, from the first. tidy: recordings that need no alignment; noisy: meshes
    whose vertices are off by .3 % of the size (standard deviation, each axis); photographs: shapes from 72 photographs
    (mesh: errors from the exact mesh; over_mesh: the error over that); offset: these shapes, and contacts 2 mm off in
    random directions. modal: error of the modes alone against the true ones, without noise; l1, l1_log, envelope:
    ratios to the mean of the three nearest, of which means are geometric; located: median distance of held-out contacts
    from where their recordings are located, over the diagonal, and in millimeters.
    """
    rows, exact = [], []
    for name in settings.objects or settings.some(tuple(objects.SETS[of])):
        capture, truth = objects.simulated(name, settings, objects.TIDY if condition == "tidy" else None)
        surface: Surface | ObjectShape = objects.surface_of(capture)
        if condition == "noisy":
            surface = objects.roughened(objects.surface_of(capture), objects.ROUGH, seed=0)
        elif condition in {"photographs", "offset"}:
            views, cloud = objects.views_and_gaussians(name, settings)
            surface = shape_of_cloud(cloud, views)
            if condition == "photographs":
                bodies = objects.bodies_of(objects.surface_of(capture), settings)
                case = objects.SplitCase.of(*split(capture.impacts, _IMPACTS[0]), capture, bodies)
                exact.append(_scores(case, truth, settings))
                yield from records(exact[-1], group="mesh", object=name)
            capture = replace(capture, surface=surface.as_seen())
        if condition == "offset":
            capture = replace(capture, impacts=_moved(capture.impacts))
        bodies = objects.bodies_of(surface, settings)
        case, *fewer = (
            objects.SplitCase.of(*split(capture.impacts, count), capture, bodies)
            for count in (_IMPACTS if not condition else _IMPACTS[:1])
        )
        rows.append(_scores(case, truth, settings))
        for each, count in zip(fewer, _IMPACTS[1:], strict=False):
            field = each.fit(MixtureEstimator(bodies=bodies), quick=settings.quick)
            rows[-1][f"error_{count}"] = each.error(field)
        if exact:
            rows[-1]["over_mesh"] = rows[-1]["error"] / exact[-1]["error"]
        yield from records(rows[-1], object=name)
    yield from records(means(rows, geometric=("l1", "l1_log", "envelope")), group="mean")


def _drift(settings: Settings) -> Iterator[Record]:
    """Error at held-out contacts of recordings whose modes shift in frequency, 8 training contacts, exact meshes.

    none: all have the same frequencies. sensor: a sensor of .05 % of the object's mass is moved with the contact.
    warming: frequencies fall by .2 % from the first to the last of 40 recordings. own: of gains by least squares in
    each held-out recording itself, stretched to the field's frequencies, without noise. located_millimeters: median
    distance of held-out contacts from where their recordings are located.
    """
    rows = []
    for name in settings.objects or settings.some(ABLATED):
        row: dict[str, float] = {}
        bodies = None
        for kind, imperfections in _SHIFTS.items():
            capture, _ = objects.simulated(name, settings, imperfections)
            bodies = bodies or objects.bodies_of(objects.surface_of(capture), settings)
            case = objects.SplitCase.of(*split(capture.impacts, 8), capture, bodies)
            field = case.fit(MixtureEstimator(bodies=bodies), quick=settings.quick)
            test = case.test
            prepared = Extractor(field.bank, sample_rate=test.sample_rate, samples=test.sounds.shape[1])
            sounds = [prepared.stretched_to_modes(sound) for sound in test.sounds]
            row |= {
                kind: case.error(field),
                f"{kind}.own": _own_error(field, replace(test, sounds=torch.stack(sounds))),
                f"{kind}.located_millimeters": 1000.0 * _located(field, test)[0],
            }
        yield from records(row, object=name)
        rows.append(row)
    yield from records(means(rows), group="mean")


def _own_error(field: SoundField, test: Impacts) -> float:
    """Return the error of each held-out recording's own gains at the field's poles, without noise."""
    own = fit_gains(test.sounds, field.bank, sample_rate=test.sample_rate)
    made = synthesize(
        own.to(torch.complex64),
        field.bank.frequency,
        field.bank.damping,
        samples=test.sounds.shape[1],
        sample_rate=test.sample_rate,
    )
    return score(made, test).mean()["relative_stft"]


def _moved(impacts: Impacts) -> Impacts:
    """Return impacts with contacts 2 mm off, in random directions."""
    ways = torch.randn(impacts.contacts.shape, generator=torch.Generator().manual_seed(0))
    return replace(impacts, contacts=impacts.contacts + 0.002 * ways / ways.norm(dim=1, keepdim=True))


def _scores(case: objects.SplitCase, truth: Truth, settings: Settings) -> dict[str, float]:
    """Return the values of one simulated object."""
    field = case.fit(MixtureEstimator(bodies=case.bodies), quick=settings.quick)
    located, size = _located(field, case.test)
    scores, averaged = evaluate(field, case.test).mean(), evaluate(MeanWaveform(case.train), case.test).mean()
    return {
        "error": scores["relative_stft"],
        "averaging": averaged["relative_stft"],
        "modal": _modal_error(field, case.test, truth),
        **{metric: scores[metric] / averaged[metric] for metric in ("l1", "l1_log", "envelope")},
        "coverage": case.coverage(field)[1],
        "located": located / size,
        "located_millimeters": 1000.0 * located,
    }


def _located(field: SoundField, test: Impacts) -> tuple[float, float]:
    """Return the median distance of held-out contacts from where recordings are located, and the diagonal, meters."""
    points = field.gain_field.points
    size = float((points.amax(0) - points.amin(0)).norm())
    locator = Locator.of(field, points=points[farthest_points(points, min(_POINTS, len(points)))])
    positions = torch.stack([locator.locate(sound).position for sound in test.sounds])
    return float((positions - test.contacts).norm(dim=1).median()), size


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


def _speed(settings: Settings) -> Iterator[Record]:
    """Fit of the built-in example to 12 contacts with its elastic modes at hand."""
    capture = objects.example_capture()
    bodies = objects.bodies_of(objects.surface_of(capture), settings)
    case = objects.SplitCase.of(*split(capture.impacts, 12), capture, bodies)
    _, seconds = timed(lambda: case.fit(MixtureEstimator(bodies=bodies), quick=settings.quick))
    yield from records({"example_fit_seconds": seconds})


PARTS: dict[str, Measurement] = {
    "captures": _captures,
    **{name: partial(_simulated, of=of) for name, of in _SETS.items()},
    **{f"{name}-photographs": partial(_simulated, condition="photographs", of=of) for name, of in _SETS.items()},
    **{f"sim20-{each}": partial(_simulated, condition=each) for each in ("tidy", "noisy", "offset")},
    "drift": _drift,
    "ablation": ablation,
    "outliers": outliers,
    "supports": supports,
    "free": free,
    "speed": _speed,
}
