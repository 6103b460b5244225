"""How near held-out blows are located: at random, by the most alike recording, by cosine and by posterior.

`python -m benchmarks.locating` goes further than `python -m benchmarks tasks`: all objects, and the network.
"""

import argparse
import itertools
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median

import torch

from avmsf.capture import Capture, read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.impacts import Impacts
from avmsf.errors import LocationError
from avmsf.evaluation.localization import METHODS, LocatingScores, judge_locating
from avmsf.evaluation.splits import split
from avmsf.evaluation.symmetric_contacts import Images, symmetries_of
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.recipes import Attention, GainRecipe
from avmsf.field.sound_field import SoundField
from avmsf.localization.locate import locate
from avmsf.localization.locator import Locator
from avmsf.localization.streaming import LocatedImpact, StreamingLocalizer
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.ground_truth import Truth, read_truth
from avmsf.simulate.shapes import make_shape
from avmsf.simulate.shapes.shape import Symmetry
from avmsf.simulate.sim20 import NON_SYMMETRIC, SIM20, sim20_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.look import slab
from benchmarks.material import STRUCK, capture_in_place, shared_data, surface_features
from benchmarks.report import Options, Report, Table, log, show
from tests.oracles.plate import Plate, plate_surface_points

AIRCRAFT_COUNT, AIRCRAFT_STARTS = 15, (0, 18, 37)
SOME = ("mug-ceramic", "blob-polycarbonate", "spoon-wood", "bowl-glass", "pot-steel")
"""Objects of the set that are judged by default: three without a turn that carries them onto themselves, two with."""
STREAM_POINTS, STREAM_BLOWS, STREAM_BLOCK = 10_000, 20, 441
"""Points of the streamed field, blows, and samples in a block: 10 ms."""
STRANGE_POINTS = 1000
"""Points that refusals are counted with: a tenth of the time, and the same refusals."""
QUIET = FitConfig(warmup_steps=20, steps=2, damping="shared")
CONVENTIONS = (
    "rmed: distance between found and true contact over the diagonal of the box around the object's points, mean over "
    "held-out strikes; modulo: to the nearest image of the truth under the object's symmetries. random: expectation "
    "over all points.",
    "fields: all kernel families, without end-to-end steps, fitted to a fifth of the strikes (aircraft: 15 of 74, "
    "three starts), spread as far apart as they go. network: the paper's, quick recipe. no_residual: fitted and "
    "located as if there were no noise.",
    "coverage90: part of the strikes that were located whose true contact lies in the 90 % region of the posterior, "
    "modulo symmetry; region: that region's part of the surface; refused: part of the strikes that were not located, "
    "which count as placed at random.",
    "ms a recording, load: processor time. latency: seconds from a blow to its answer, as it was; unloaded: with "
    "processor time in place of the time that passed, which is longer beside other work.",
)


@dataclass(frozen=True, eq=False)
class LocatingCase:
    """One object: what to learn from, what to locate, and what is known of it."""

    name: str
    train: Impacts
    test: Impacts
    features: FeatureField
    recipe: GainRecipe
    images: Images
    truth: torch.Tensor | None = None
    """True contacts of the test strikes, where they are known better than the recordings' table has them."""


@dataclass(frozen=True)
class LocatingOptions:
    """What is measured."""

    parts: tuple[str, ...] = ()
    """Of `PARTS`; all without any."""
    sim20: Path | None = None
    """Folder of the set, as `avmsf simulate sim-20` makes it; without it, objects are simulated here."""
    every: bool = False
    """All twenty objects in place of some."""
    network: bool = False
    """The paper's network as well."""
    output: Path | None = None
    """Folder for every strike's rows as JSON."""
    cache: Path | None = None
    """Folder that keeps elastic modes; a temporary one without it."""
    quick_look: bool = False


def figures(options: LocatingOptions | None = None) -> dict[str, float]:
    """Measure, print the table, and return every figure under its key."""
    chosen = LocatingOptions() if options is None else options
    report = measure_locating(chosen)
    show(report, Options(chosen.parts or tuple(PARTS), chosen.quick_look), name="locating")
    return dict(report.figures)


def measure(options: Options) -> Report:
    """Return the chosen parts' figures."""
    return measure_locating(LocatingOptions(options.parts, quick_look=options.quick_look))


def measure_locating(options: LocatingOptions) -> Report:
    """Return the chosen parts' figures with all options."""
    with tempfile.TemporaryDirectory() as temporary:
        kept = replace(options, cache=options.cache or Path(temporary))
        report = Report(CONVENTIONS)
        for part in options.parts or tuple(PARTS):
            report += PARTS[part](kept)
        return report


def _plate(options: LocatingOptions) -> Report:
    count, seconds = (20, 0.25) if options.quick_look else (100, 1.5)
    train, test = split(STRUCK.strikes(count, seconds=seconds), 0.2)
    recipe = _estimator(slab(STRUCK.plate), 0.0, "plate", options)
    case = LocatingCase("plate", train, test, STRUCK.features(), recipe, plate_images(STRUCK.plate))
    return _table("plate", {"plate": [case]}, options)


def _aircraft(options: LocatingOptions) -> Report:
    capture = capture_in_place("aircraft_response")
    assert capture.surface is not None
    recipe = _estimator(capture.surface, 0.0, "aircraft", options)
    features, cases = surface_features(capture), []
    for start in AIRCRAFT_STARTS[: 1 if options.quick_look else None]:
        train, test = split(capture.impacts, AIRCRAFT_COUNT, start=start)
        name = f"aircraft, start {start}"
        # Its engines and sensors break the symmetry of its shape: no place counts but the true one.
        cases.append(LocatingCase(name, train, test, features, recipe, Images.none()))
    return _table("aircraft", {"aircraft": cases}, options)


def _sim20(options: LocatingOptions) -> Report:
    names = tuple(SIM20) if options.every else SOME[:1] if options.quick_look else SOME
    cases = [_sim20_case(name, options) for name in names]
    uneven = [case for case in cases if case.name in NON_SYMMETRIC]
    return _table("sim20", {"sim20": cases, "sim20_nonsymmetric": uneven}, options)


def _sim20_case(name: str, options: LocatingOptions) -> LocatingCase:
    capture, truth = _simulated(name, options)
    assert capture.surface is not None
    train, test = split(capture.impacts, 0.2)
    row_of = {each: row for row, each in enumerate(truth.names)}
    rows = [row_of[each] for each in test.names]
    recipe = sim20_recipe(name)
    shape = make_shape(recipe.kind, seed=recipe.seed, size=recipe.size, wall=recipe.thickness)
    return LocatingCase(
        name,
        train,
        test,
        surface_features(capture),
        _estimator(capture.surface, None, name, options),
        Images.of(symmetries_of(shape.symmetry)),
        None if truth.contacts is None else truth.contacts[rows],
    )


def _simulated(name: str, options: LocatingOptions) -> tuple[Capture, Truth]:
    """Return an object of the set and its truth, from the folder or made anew."""
    if options.sim20 is not None:
        folder = options.sim20 / name
        return read_capture(folder), read_truth(folder)
    log(f"locate.sim20: simulating {name}")
    made = simulate_object(sim20_recipe(name), name=name, cache=options.cache)
    return made.capture, made.truth


def _estimator(surface: Surface, wall: float | None, name: str, options: LocatingOptions) -> MixtureEstimator:
    config = BodyConfig(wall=wall, shapes=12, dofs=3000) if options.quick_look else BodyConfig(wall=wall)
    assert options.cache is not None
    log(f"locate.{name}: elastic bodies")
    return MixtureEstimator(bodies=candidate_bodies(surface, config, cache=options.cache / name))


def plate_images(plate: Plate) -> Images:
    """Return the four images of a place on a rectangular plate."""
    middle = torch.tensor([plate.length / 2, plate.width / 2, 0.0], dtype=torch.float64)
    normals = torch.eye(3, dtype=torch.float64)[:2]
    return Images.of(symmetries_of(Symmetry("two mirror planes", mirrors=normals, point=middle)))


def _table(key: str, groups: dict[str, list[LocatingCase]], options: LocatingOptions) -> Report:
    """Judge every case once, and return the means of each group of them."""
    judged: dict[str, dict[str, LocatingScores]] = {}
    seconds: list[float] = []
    for case in dict.fromkeys(case for group in groups.values() for case in group):
        judged[case.name] = _judged(case, options, seconds)
    found: dict[str, float] = {f"locate.{key}.seconds": sum(seconds) / len(seconds)}
    rows: list[list[str | float]] = []
    for group, cases in groups.items():
        for kind in judged[cases[0].name] if cases else ():
            scores = [judged[case.name][kind] for case in cases]
            for method in METHODS:
                if kind and method in ("random", "nearest"):
                    continue
                name = f"{group}.{kind}.{method}" if kind else f"{group}.{method}"
                means = _means(scores, method)
                found |= {f"locate.{name}.{metric}": means[metric] for metric in ("rmed", "rmed_modulo")}
                if "covered_modulo" in means:
                    found[f"locate.{group}{'.' + kind if kind else ''}.coverage90"] = means["covered_modulo"]
                    found[f"locate.{group}{'.' + kind if kind else ''}.region90"] = means["region"]
                covered = [means.get(metric, float("nan")) for metric in ("covered_modulo", "region")]
                rows.append([name, means["rmed"], means["rmed_modulo"], *covered, means["refused"]])
    names = ", ".join(judged)
    title = f"locate.{key}: {names}; {1000 * found[f'locate.{key}.seconds']:.0f} ms a recording"
    columns = ("method", "rmed", "rmed modulo", "coverage90", "region90", "refused")
    return Report(tables=(Table(title, columns, rows),), figures=found)


def _judged(case: LocatingCase, options: LocatingOptions, seconds: list[float]) -> dict[str, LocatingScores]:
    """Return a case's scores: with bodies under the empty name, then without residual and by the network."""
    modes = extract_modes(case.train)
    silent = replace(modes, residual=Residual(torch.zeros_like(modes.residual.magnitude)))
    plain = FitConfig(steps=0)
    runs: dict[str, tuple[GainRecipe, Extraction, FitConfig]] = {
        "": (case.recipe, modes, plain),
        "no_residual": (case.recipe, silent, replace(plain, residual=False)),
    }
    if options.network:
        config = QUIET if options.quick_look else FitConfig()
        runs["network"] = (Attention(), modes, config)
        runs["network_no_residual"] = (Attention(), silent, replace(config, residual=False))
    scores = {}
    for kind, (recipe, extraction, config) in runs.items():
        field = fit(case.train, case.features, extraction, config, gains=recipe)
        locator = Locator.of(field, use_residual=config.residual)
        locator.locate(case.test.sounds[0])
        begun = time.process_time()
        locator.locate(case.test.sounds[0])
        seconds.append(time.process_time() - begun)
        settings = {"seed": config.seed, "field": recipe.name, "residual": config.residual}
        scores[kind] = judge_locating(
            locator,
            case.train,
            case.test,
            name=case.name,
            images=case.images,
            truth=case.truth,
            settings=settings | {"trained_on": list(case.train.names)},
        )
        means = {method: round(scores[kind].figures(method)["rmed_modulo"], 4) for method in METHODS}
        log(f"locate: {case.name} {kind or 'all families'}: {json.dumps(means)}")
        if options.output is not None:
            scores[kind].write(options.output / f"{case.name}{'-' + kind if kind else ''}.json")
    return scores


def _other_objects(options: LocatingOptions) -> Report:
    """Count what `locate` refuses: of an object's own recordings, and of sounds that are none of its."""
    names = ("aircraft_response", "tree43", "ruler10")
    captures = {name: read_capture(shared_data() / name) for name in names}
    rows: list[list[str | float]] = []
    found: dict[str, float] = {}
    for name, counts, starts in zip(names, (15, 20, 5), (AIRCRAFT_STARTS, (0, 15), (0, 5)), strict=True):
        capture, heard = captures[name], dict[str, list[str | None]]()
        for start in starts[: 1 if options.quick_look else None]:
            train, test = split(capture.impacts, counts, start=start)
            # The tree has no mesh: its contacts are points enough.
            bare = FeatureField.from_points(capture.impacts.contacts.float())
            wall = 0.0 if name == names[0] else None
            surface = capture.surface
            recipe = MixtureEstimator() if surface is None else _estimator(surface, wall, name, options)
            features = bare if surface is None else surface_features(capture)
            field = fit(train, features, extract_modes(train), FitConfig(steps=0), gains=recipe)
            locator = Locator.of(
                field, points=field.gain_field.points[:: max(1, len(features.points) // STRANGE_POINTS)]
            )
            others = {"held out": test.sounds, "trained on": train.sounds}
            others |= {
                f"of {other}": captures[other].impacts.sounds[:: max(1, len(captures[other].impacts) // 12)]
                for other in names
                if other != name
            }
            for kind, sounds in (others | strange_noises(field.samples, field.sample_rate) | _clips()).items():
                heard.setdefault(kind, []).extend(_refusal(field, locator, sound.float()) for sound in sounds)
        for kind, refusals in heard.items():
            share = mean(refusal is not None for refusal in refusals)
            by_gains = sum(refusal is not None and "log Bayes factor" in refusal for refusal in refusals)
            found[f"locate.other_objects.{name}.{kind.replace(' ', '_')}"] = share
            rows.append([f"{name}: {kind}", len(refusals), share, by_gains])
    title = "locate.other_objects: sounds at the field's rate, and the part of them that is refused"
    return Report(tables=(Table(title, ("sounds", "count", "refused", "by their gains"), rows),), figures=found)


def _refusal(field: SoundField, locator: Locator, sound: torch.Tensor) -> str | None:
    try:
        return locate(field, sound, locator=locator, progress=False).refusal
    except LocationError as error:
        return str(error)


def _clips() -> dict[str, list[torch.Tensor]]:
    """Return recordings of other objects from their loudest sample on, at whatever rate."""
    folders = ("bowl_clips", "hammer_clips", "realimpact_clips")
    paths = [path for name in folders for path in sorted((shared_data() / name).glob("*.wav"))]
    sounds = [torch.from_numpy(read_recording(path).channels[0].copy()).float() for path in paths]
    return {"clips": [sound[int(sound.abs().argmax()) :] for sound in sounds]}


def strange_noises(samples: int, rate: float, count: int = 10) -> dict[str, list[torch.Tensor]]:
    """Return white noise, the same decaying, bursts of band noise as in speech, and hum with its harmonics."""
    generator = torch.Generator().manual_seed(0)
    time, part = torch.arange(samples) / rate, torch.arange(samples) / samples
    white = torch.randn(3, count, samples, generator=generator)
    spectrum = torch.fft.rfft(white[1])
    place = torch.linspace(0.0, 1.0, spectrum.shape[1])
    middle = 0.04 + 0.8 * torch.rand(count, 3, 1, generator=generator)
    formants = torch.exp(-(((place - middle) / 0.06) ** 2)).sum(1)
    speech = torch.fft.irfft(formants * spectrum, n=samples) * torch.sin(10.0 * math.pi * part).clamp_min(0.0)
    decay = 4.0 * torch.exp(2.0 * torch.rand(count, 1, generator=generator))
    # A sixteenth of the rate stands for the mains where the rate is as low as the aircraft's.
    base = min(50.0, rate / 16.0) * (1.0 + 0.01 * torch.randn(count, 1, generator=generator))
    hum = sum(torch.sin(2.0 * math.pi * base * order * time + order) / order for order in (1, 2, 3, 5, 7))
    assert isinstance(hum, torch.Tensor)
    return {
        "white noise": list(white[0]),
        "decaying noise": list(white[2] * torch.exp(-decay * part)),
        "bursts as of speech": list(speech),
        "hum": list(hum + 0.01 * white[0]),
    }


def _means(scores: Iterable[LocatingScores], method: str) -> dict[str, float]:
    """Return the means over objects, each counting the same."""
    each = [one.figures(method) for one in scores]
    known = {name: [one[name] for one in each if name in one] for name in dict.fromkeys(itertools.chain(*each))}
    return {name: sum(values) / len(values) for name, values in known.items()}


def _stream(options: LocatingOptions) -> Report:
    """Locate blows as they come, on a field of 10,000 points, beside the ringing of those before."""
    seconds = 0.5 if options.quick_look else 1.5
    train, test = split(STRUCK.strikes(40, seconds=seconds), 0.5)
    features = FeatureField.from_points(plate_surface_points(STRUCK.plate, STREAM_POINTS))
    field = fit(
        train,
        features,
        extract_modes(train),
        FitConfig(steps=0),
        gains=_estimator(slab(STRUCK.plate), 0.0, "plate", options),
    )
    begun = time.process_time()
    listener = StreamingLocalizer(Locator.of(field))
    prepared = time.process_time() - begun
    stream, begins = streamed(test, STREAM_BLOWS)
    blows: list[LocatedImpact] = []
    unloaded: list[float] = []
    computed = 0.0
    for number, block in enumerate(torch.split(stream, STREAM_BLOCK), start=1):
        begun = time.process_time()
        answers = listener.process(block)
        taken = time.process_time() - begun
        computed += taken
        blows += answers
        unloaded += [number * STREAM_BLOCK / field.sample_rate - blow.seconds + taken for blow in answers]
    errors = []
    for row, begin in enumerate(begins):
        near = [blow for blow in blows if abs(blow.seconds - begin / field.sample_rate) < 0.002]
        if near:
            truth = test.contacts[row % len(test)].double()
            apart = (plate_images(STRUCK.plate).at(truth) - near[0].map.position.double()).norm(dim=1)
            errors.append(float(apart.min()) / float((features.points.amax(0) - features.points.amin(0)).norm()))
    waited, unloaded = [blow.latency for blow in blows] or [math.nan], unloaded or [math.nan]
    found = {
        "locate.stream.heard": len(errors) / len(begins),
        "locate.stream.false": float(len(blows) - len(errors)),
        "locate.stream.rmed_modulo": mean(errors) if errors else math.nan,
        "locate.stream.latency_median": median(waited),
        "locate.stream.latency_worst": max(waited),
        "locate.stream.latency_unloaded_median": median(unloaded),
        "locate.stream.latency_unloaded_worst": max(unloaded),
        "locate.stream.load": computed / (len(stream) / field.sample_rate),
        "locate.stream.prepare_seconds": prepared,
    }
    title = f"locate.stream: {len(begins)} blows, .15 to .5 s apart, {len(features.points)} points, blocks of 10 ms"
    rows: list[list[str | float]] = [[name.removeprefix("locate.stream."), value] for name, value in found.items()]
    return Report(tables=(Table(title, ("what", "part, seconds or rmed"), rows),), figures=found)


def streamed(test: Impacts, count: int) -> tuple[torch.Tensor, list[int]]:
    """Return blows of drawn forces one after the other while earlier ones ring, and the samples they begin at."""
    generator = torch.Generator().manual_seed(0)
    pauses = 0.15 + 0.35 * torch.rand(count, generator=generator, dtype=torch.float64)
    forces = (0.5 + torch.rand(count, generator=generator)) * torch.randn(count, generator=generator).sign()
    begins = [round(value) for value in (torch.cumsum(pauses, 0) * test.sample_rate).tolist()]
    length = test.sounds.shape[1]
    level = 0.01 * float(test.sounds.square().mean().sqrt())
    stream = level * torch.randn(begins[-1] + length, generator=generator)
    for row, (begin, force) in enumerate(zip(begins, forces.tolist(), strict=True)):
        stream[begin : begin + length] += force * test.sounds[row % len(test)]
    return stream, begins


PARTS: dict[str, Callable[[LocatingOptions], Report]] = {
    "plate": _plate,
    "aircraft": _aircraft,
    "sim20": _sim20,
    "stream": _stream,
    "other-objects": _other_objects,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what the command line asks for, and print it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.locating", description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=["sim20"], help="by itself sim20")
    parser.add_argument("--sim20", type=Path, help="the set as `avmsf simulate sim-20` makes it; made anew without it")
    parser.add_argument("--every", action="store_true", help="all twenty objects of the set in place of five")
    parser.add_argument("--network", action="store_true", help="the paper's network as well")
    parser.add_argument("--output", type=Path, help="folder for every strike's rows as JSON")
    parser.add_argument("--cache", type=Path, help="folder that keeps elastic modes")
    chosen = parser.parse_args(arguments)
    figures(
        LocatingOptions(tuple(chosen.parts), chosen.sim20, chosen.every, chosen.network, chosen.output, chosen.cache)
    )


if __name__ == "__main__":
    main()
