"""How near rendered sounds come to recorded ones at contacts that were held out."""

import time
from collections.abc import Callable
from dataclasses import replace

from avmsf.bench.baselines import MeanGains, MeanWaveform, NearestStrike, WhiteNoise, floor, sine_floor
from avmsf.bench.conventions import PAPER
from avmsf.bench.evaluation import Scores, evaluate, score, split
from avmsf.bench.renderer import Renderer
from avmsf.capture import Impacts, Surface
from avmsf.capture.texturedmesh import TexturedMesh
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.modal.extract import extract
from avmsf.scene.features import FeatureField
from benchmarks.look import finish, lift_pictures, pictures, slab, speckled
from benchmarks.material import IMPULSE, STRUCK, PlateCase, capture_in_place, surface_features
from benchmarks.report import Options, Report, Table, tell

METHODS = ("white_noise", "nearest", "knn3_waveform", "knn3_gains", "warmup", "field", "floor", "sine_floor")
AIRCRAFT_COUNTS = (8, 15, 28)
AIRCRAFT_STARTS = (0, 18, 37)
QUICK_LOOK = FitConfig(warmup_steps=20, steps=2, damping="shared")
CONVENTIONS = (
    "error: relative STFT error at held-out contacts, that is sums over bins and frames of absolute differences of "
    "magnitudes over the truth's sums; mean over FFT 2048/1024/512/256 at 44.1 kHz, 512/256/128/64 at 400 Hz; hop a "
    "quarter.",
    f"l1, l1_log, envelope: convention '{PAPER.name}' of avmsf.bench.conventions, mean over held-out contacts.",
    "knn3: of the 3 nearest contacts. warmup: the field after its warm-up alone. field: after training, quick recipe.",
    "floor: held-out sounds' own gains, in phase and in quadrature, with the training modes; sine_floor: in phase "
    "alone.",
)

Figures = dict[str, float]


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
    train, test = split(case.strikes(count, seconds=seconds), fraction=0.2)
    figures = _judge(key, train, test, case.features(), options)
    title = f"{key}: {title}; {count} contacts, {len(train)} to train on, {seconds:g} s at 44.1 kHz, noise 40 dB down"
    return Report(tables=(_table(title, figures),), figures=_prefixed(key, figures))


def _aircraft(options: Options) -> Report:
    capture = capture_in_place("aircraft_response")
    features = surface_features(capture)
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
            train, test = split(capture.impacts, count=count, start=start)
            runs.append(_judge(f"{key}, start {start}", train, test, features, options))
        figures = {name: sum(run[name] for run in runs) / len(runs) for name in runs[0]}
        title = (
            f"{key}: aircraft_response, {count} of {len(capture.impacts)} contacts to train on, farthest points from "
            f"contact {', '.join(map(str, starts))}, mean"
        )
        report += Report(tables=(_table(title, figures),), figures=_prefixed(key, figures))
    return report


def _visual(options: Options) -> Report:
    """Fit the same recordings with positions alone and with lifted features, pooled over symmetries or not."""
    cases = {"visual.plate": _visual_plate(options), "visual.aircraft": _visual_aircraft(options)}
    report = Report()
    for key, (train, test, surface, mesh, geometry) in cases.items():
        views = pictures(mesh, count=12 if options.quick_look else 72, size=48 if options.quick_look else 256)
        lifted = lift_pictures(surface, views)
        variants = {
            "positions": geometry,
            "visual": finish(lifted, symmetry=False).features,
            "visual_symmetric": finish(lifted, symmetry=True).features,
            "visual_alone": finish(lifted, symmetry=False, positions=False).features,
            "visual_alone_symmetric": finish(lifted, symmetry=True, positions=False).features,
        }
        modes, config = extract(train), QUICK_LOOK if options.quick_look else FitConfig()
        figures: Figures = {}
        rows: list[list[str | float]] = []
        for name, features in variants.items():
            means = evaluate(fit(train, features, modes, config), test).mean()
            figures[f"{key}.{name}"] = means["relative_stft"]
            rows.append([name, *means.values()])
            tell(f"{key}, {name}: {means['relative_stft']:.3f}")
        title = f"{key}: built-in descriptors of {len(views)} pictures, {len(train)} contacts to train on"
        report += Report(
            tables=(Table(title, ("features", "error", "l1", "l1_log", "envelope"), rows),), figures=figures
        )
    return report


Visual = tuple[Impacts, Impacts, Surface, TexturedMesh, FeatureField]


def _visual_plate(options: Options) -> Visual:
    count, seconds = (20, 0.25) if options.quick_look else (100, 1.5)
    train, test = split(STRUCK.strikes(count, seconds=seconds), fraction=0.2)
    surface = slab(STRUCK.plate)
    return train, test, surface, speckled(surface, seed=0), STRUCK.features()


def _visual_aircraft(options: Options) -> Visual:
    capture = capture_in_place("aircraft_response")
    assert capture.surface is not None
    train, test = split(capture.impacts, count=15)
    return train, test, capture.surface, TexturedMesh.plain(capture.surface), surface_features(capture)


PARTS: dict[str, Callable[[Options], Report]] = {
    "plate": _plate,
    "plate_impulse": _plate_impulse,
    "aircraft": _aircraft,
    "visual": _visual,
}


def _judge(name: str, train: Impacts, test: Impacts, features: FeatureField, options: Options) -> Figures:
    """Return METHOD and METHOD.METRIC for all methods, on one extraction that they share."""
    config = QUICK_LOOK if options.quick_look else FitConfig()
    begun = time.perf_counter()
    modes = extract(train)
    extracted = time.perf_counter()
    fitted = fit(train, features, modes, config)
    done = time.perf_counter()
    renderers: dict[str, Renderer] = {
        "white_noise": WhiteNoise(train),
        "nearest": NearestStrike(train),
        "knn3_waveform": MeanWaveform(train),
        "knn3_gains": MeanGains(train, modes),
        # The warm-up moves no damping, so there is nothing to choose between.
        "warmup": fit(train, features, modes, replace(config, steps=0, damping="shared")),
        "field": fitted,
    }
    scores = {method: evaluate(renderer, test) for method, renderer in renderers.items()}
    scores["floor"] = score(floor(test, modes.bank), test)
    scores["sine_floor"] = score(sine_floor(test, modes.bank), test)
    figures = {"modes": float(len(modes.bank))}
    for method in METHODS:
        figures |= _of_method(method, scores[method])
    figures |= {"extract_seconds": extracted - begun, "fit_seconds": done - extracted}
    tell(
        f"{name}: {len(modes.bank)} modes in {extracted - begun:.1f} s, fit in {done - extracted:.1f} s, "
        f"{fitted.origin.report.get('damping')} damping, error {figures['field']:.3f} (floor {figures['floor']:.3f})"
    )
    return figures


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
