"""How near rendered sounds come to recorded ones at contacts that were held out."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import trimesh
from jaxtyping import Complex128
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.evaluation.scores import Scores, evaluate, score
from avmsf.evaluation.simple_methods import MeanGains, MeanWaveform, NearestRecording, WhiteNoise, floor
from avmsf.evaluation.splits import split
from avmsf.evaluation.task import Renderer
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import along_phase
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.posterior import coverage
from avmsf.field.sound_field import SoundField
from avmsf.mesh import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.extraction.least_squares import fit_gains
from benchmarks.look import finish, lift_pictures, pictures, slab, speckled
from benchmarks.material import IMPULSE, STRUCK, PlateCase, capture_in_place, surface_features
from benchmarks.report import Options, Report, Table, log

METHODS = (
    "white_noise",
    "nearest",
    "knn3_waveform",
    "knn3_gains",
    "warmup",
    "field",
    "no_body",
    "auto",
    "floor",
    "sine_floor",
)
AIRCRAFT_COUNTS = (8, 15, 28)
AIRCRAFT_STARTS = (0, 18, 37)
CROSSED = 15
"""Contacts to train on where geometry and labels are wrong."""
MISLABELLED = 3
"""Recordings whose labels change places then."""
QUICK_LOOK = FitConfig(warmup_steps=20, steps=2, damping="shared")
CONVENTIONS = (
    "error: relative STFT error at held-out contacts, that is sums over bins and frames of absolute differences of "
    "magnitudes over the truth's sums; mean over FFT 2048/1024/512/256 at 44.1 kHz, 512/256/128/64 at 400 Hz; hop a "
    "quarter.",
    "l1, l1_log, envelope: the paper's, as avmsf.evaluation.metrics has them, mean over held-out contacts.",
    "knn3: of the 3 nearest contacts. warmup: the network after its warm-up alone. field: the network after training, "
    "quick recipe; auto: the same with the Gaussian process over all kernel families, no_body: without elastic mode "
    "shapes.",
    "thin, thick: plates of half and of twice the nominal thickness. mislabelled: the labels of 3 recordings, drawn "
    "with the start as seed, have changed places; mislabelled_named, others_named: part of these, and number of "
    "others, that the fit names as outliers.",
    "coverage90: part of the held-out sounds' own gains, all alike, in the 90 % interval of auto; by_energy: by their "
    "energy.",
    "floor: held-out sounds' own gains, in phase and in quadrature, with the training modes; sine_floor: in phase "
    "alone.",
)

Figures = dict[str, float]


def filled_estimator(surface: Surface, options: Options) -> MixtureEstimator:
    """Return the gain models' estimator for an object with this surface: a filled body, coarse for a quick look."""
    shapes, dofs = (12, 20_000) if options.quick_look else (60, 40_000)
    return MixtureEstimator(bodies=SurfaceBodies(surface, thicknesses=[None], count=shapes, dofs=dofs))


def measure(options: Options) -> Report:
    """Return all methods' errors on the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _plate(options: Options) -> Report:
    return _of_plate("plate", "4 mm plate, hammer's tip of .5 ms", STRUCK, 3.0, options)


def _plate_impulse(options: Options) -> Report:
    return _of_plate("plate_impulse", "2 mm plate, ideal impulse, 43 modes of equal strength", IMPULSE, 1.5, options)


def _of_plate(key: str, title: str, case: PlateCase, seconds: float, options: Options) -> Report:
    count, seconds = (20, 0.25) if options.quick_look else (100, seconds)
    train, test = split(case.strikes(count, seconds=seconds), 0.2)
    figures = _judge(key, train, test, case.features(), filled_estimator(slab(case.plate), options), options)
    title = f"{key}: {title}; {count} contacts, {len(train)} to train on, {seconds:g} s at 44.1 kHz, noise 40 dB down"
    return Report(tables=(_table(title, figures),), figures=_prefixed(key, figures))


def _aircraft(options: Options) -> Report:
    capture = capture_in_place("aircraft_response")
    features = surface_features(capture)
    assert capture.surface is not None
    estimator = filled_estimator(capture.surface, options)
    counts, starts = (
        (AIRCRAFT_COUNTS[:1], AIRCRAFT_STARTS[:1])
        if options.quick_look
        else (
            AIRCRAFT_COUNTS,
            AIRCRAFT_STARTS,
        )
    )
    report = Report()
    for count in counts:
        key = f"aircraft.{count}"
        runs = []
        for start in starts:
            train, test = split(capture.impacts, count, start=start)
            runs.append(_judge(f"{key}, start {start}", train, test, features, estimator, options))
        figures = {name: sum(run[name] for run in runs) / len(runs) for name in runs[0]}
        title = (
            f"{key}: aircraft_response, {count} of {len(capture.impacts)} contacts to train on, farthest points from "
            f"contact {', '.join(map(str, starts))}, mean"
        )
        report += Report(tables=(_table(title, figures),), figures=_prefixed(key, figures))
    held = [report.figures[f"aircraft.{count}.auto.coverage90"] for count in counts]
    return report + Report(figures={"aircraft.coverage90": sum(held) / len(held)})


def _crossed(options: Options) -> Report:
    """Fit where the plates' thickness, or some labels, are wrong."""
    capture = capture_in_place("aircraft_response")
    features = surface_features(capture)
    assert capture.surface is not None
    config = QUICK_LOOK if options.quick_look else FitConfig()
    bodies = {
        "auto": capture.surface,
        "thin": thickened(capture.surface, 0.5),
        "thick": thickened(capture.surface, 2.0),
    }
    estimators = {name: filled_estimator(surface, options) for name, surface in bodies.items()}
    runs: list[Figures] = []
    for start in AIRCRAFT_STARTS[:1] if options.quick_look else AIRCRAFT_STARTS:
        train, test = split(capture.impacts, CROSSED, start=start)
        modes = extract_modes(train)
        train, test = modes.aligned(train), modes.aligned(test)
        errors = {
            name: evaluate(fit(train, features, modes, config, gains=estimator), test).mean()["relative_stft"]
            for name, estimator in estimators.items()
        }
        wrong, moved = mislabelled(train, MISLABELLED, seed=start)
        fitted = fit(moved, features, modes, config, gains=estimators["auto"])
        named = fitted.origin.report.get("outliers", {})
        errors["mislabelled"] = evaluate(fitted, test).mean()["relative_stft"]
        errors["mislabelled_named"] = sum(name in named for name in wrong) / len(wrong)
        errors["others_named"] = float(sum(name not in wrong for name in named))
        log(f"start {start}: {errors}; wrong {', '.join(wrong)}; named {'; '.join(named.values())}")
        runs.append(errors)
    means = {name: sum(run[name] for run in runs) / len(runs) for name in runs[0]}
    title = f"aircraft.{CROSSED}: what is known of the object is wrong; mean of starts"
    rows: list[list[str | float]] = [[name, value] for name, value in means.items()]
    figures = {f"aircraft.{CROSSED}.{name}": value for name, value in means.items() if name != "auto"}
    return Report(tables=(Table(title, ("what", "error or part"), rows),), figures=figures)


def thickened(surface: Surface, factor: float) -> Surface:
    """Return a surface of boxes whose thinnest sides are `factor` times as long, about their middles.

    What thinner boxes lose they gain at their edges, so that those which met still do.
    """
    parts = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=True).split(only_watertight=False)
    for part in parts:
        middle = part.vertices.mean(axis=0)
        _, axes = np.linalg.eigh((part.vertices - middle).T @ (part.vertices - middle))
        along = (part.vertices - middle) @ axes
        lost = max(0.0, 1.0 - factor) * float(np.ptp(along[:, 0]))
        along[:, 0] *= factor
        along[:, 1:] += lost * np.sign(along[:, 1:])
        part.vertices = middle + along @ axes.T
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, first[:-1], strict=True)])
    return Surface(torch.from_numpy(vertices).float(), torch.from_numpy(faces).long())


def mislabelled(train: Impacts, count: int, *, seed: int) -> tuple[tuple[str, ...], Impacts]:
    """Return the recordings of which `count`, drawn at random, have one another's contacts, and their names."""
    drawn = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))[:count]
    rows = torch.arange(len(train))
    rows[drawn] = drawn.roll(1)
    directions = None if train.directions is None else train.directions[rows]
    names = tuple(train.names[row] for row in sorted(drawn.tolist()))
    return names, replace(train, contacts=train.contacts[rows], directions=directions)


def _visual(options: Options) -> Report:
    """Fit the same recordings with positions alone and with lifted features, pooled over symmetries or not."""
    cases = {"visual.plate": _visual_plate(options), "visual.aircraft": _visual_aircraft(options)}
    report = Report()
    for key, (train, test, surface, mesh, geometry) in cases.items():
        views = pictures(mesh, count=12 if options.quick_look else 72, size=48 if options.quick_look else 256)
        lifted = lift_pictures(surface, views)
        variants = {
            "positions": geometry,
            "visual": finish(lifted, symmetry=False),
            "visual_symmetric": finish(lifted, symmetry=True),
            "visual_alone": finish(lifted, symmetry=False, positions=False),
            "visual_alone_symmetric": finish(lifted, symmetry=True, positions=False),
        }
        modes, config = extract_modes(train), QUICK_LOOK if options.quick_look else FitConfig()
        train, test = modes.aligned(train), modes.aligned(test)
        figures: Figures = {}
        rows: list[list[str | float]] = []
        for name, features in variants.items():
            means = evaluate(fit(train, features, modes, config, gains=Attention()), test).mean()
            figures[f"{key}.{name}"] = means["relative_stft"]
            rows.append([name, *means.values()])
            log(f"{key}, {name}: {means['relative_stft']:.3f}")
        title = f"{key}: built-in descriptors of {len(views)} pictures, {len(train)} contacts to train on"
        report += Report(
            tables=(Table(title, ("features", "error", "l1", "l1_log", "envelope"), rows),), figures=figures
        )
    return report


Visual = tuple[Impacts, Impacts, Surface, TexturedMesh, FeatureField]


def _visual_plate(options: Options) -> Visual:
    count, seconds = (20, 0.25) if options.quick_look else (100, 1.5)
    train, test = split(STRUCK.strikes(count, seconds=seconds), 0.2)
    surface = slab(STRUCK.plate)
    return train, test, surface, speckled(surface, seed=0), STRUCK.features()


def _visual_aircraft(options: Options) -> Visual:
    capture = capture_in_place("aircraft_response")
    assert capture.surface is not None
    train, test = split(capture.impacts, 15)
    return train, test, capture.surface, TexturedMesh.plain(capture.surface), surface_features(capture)


PARTS: dict[str, Callable[[Options], Report]] = {
    "plate": _plate,
    "plate_impulse": _plate_impulse,
    "aircraft": _aircraft,
    "crossed": _crossed,
    "visual": _visual,
}


def _judge(
    name: str, train: Impacts, test: Impacts, features: FeatureField, estimator: MixtureEstimator, options: Options
) -> Figures:
    """Return METHOD and METHOD.METRIC for all methods, on one extraction that they share."""
    config = QUICK_LOOK if options.quick_look else FitConfig()
    begun = time.perf_counter()
    modes = extract_modes(train)
    train, test = modes.aligned(train), modes.aligned(test)
    extracted = time.perf_counter()
    fitted = fit(train, features, modes, config, gains=Attention())
    done = time.perf_counter()
    others = {"no_body": MixtureEstimator(), "auto": estimator}
    fields = {method: fit(train, features, modes, config, gains=gains) for method, gains in others.items()}
    renderers: dict[str, Renderer] = {
        "white_noise": WhiteNoise(train),
        "nearest": NearestRecording(train),
        "knn3_waveform": MeanWaveform(train),
        "knn3_gains": MeanGains(train, modes),
        # The warm-up moves no damping, so there is nothing to choose between.
        "warmup": fit(train, features, modes, replace(config, steps=0, damping="shared"), gains=Attention()),
        "field": fitted,
        **fields,
    }
    scores = {method: evaluate(renderer, test) for method, renderer in renderers.items()}
    scores["floor"] = score(floor(test, modes.bank), test)
    scores["sine_floor"] = score(floor(test, modes.bank, sines=True), test)
    figures = {"modes": float(len(modes.bank))}
    for method in METHODS:
        figures |= _of_method(method, scores[method])
    known = fields["auto"]
    heard = measured_gains(test, known)
    held = coverage(known, test.contacts, heard, directions=test.directions, level=0.9)
    figures |= {"auto.coverage90": held.plain, "auto.coverage90_by_energy": held.by_energy}
    figures |= {"extract_seconds": extracted - begun, "fit_seconds": done - extracted}
    log(
        f"{name}: {len(modes.bank)} modes in {extracted - begun:.1f} s, fit in {done - extracted:.1f} s, "
        f"{fitted.origin.report.get('damping')} damping, error {figures['field']:.3f} (no_body "
        f"{figures['no_body']:.3f}, auto {figures['auto']:.3f}, floor {figures['floor']:.3f})"
    )
    return figures


def measured_gains(test: Impacts, field: SoundField) -> Complex128[Tensor, "contacts modes"]:
    """Return the recordings' own gains with a field's modes, relative to each mode's phase."""
    gains = fit_gains(test.sounds.double(), field.bank, sample_rate=test.sample_rate)
    return along_phase(gains, field.phase)


def _of_method(method: str, scores: Scores) -> Figures:
    means = scores.mean()
    return {method: means.pop("relative_stft")} | {f"{method}.{metric}": value for metric, value in means.items()}


def _prefixed(key: str, figures: Figures) -> Figures:
    return {f"{key}.{name}": value for name, value in figures.items()}


def _table(title: str, figures: Figures) -> Table:
    metrics = ("l1", "l1_log", "envelope")
    rows: list[list[str | float]] = [
        [method, figures[method], *(figures[f"{method}.{metric}"] for metric in metrics)] for method in METHODS
    ]
    seconds = f"{figures['extract_seconds']:.1f} s to extract, {figures['fit_seconds']:.1f} s to fit"
    return Table(f"{title} ({figures['modes']:.3g} modes; {seconds})", ("method", "error", *metrics), rows)
