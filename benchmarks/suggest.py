"""Whether strikes where `suggest` says are worth more than strikes spread as far apart as they go."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from avmsf.capture import Capture, Impacts
from avmsf.evaluation.scores import evaluate
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.next_contacts import suggest
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.points import farthest_points
from avmsf.modal.extraction.alignment import align
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.recipe import named_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.material import capture_in_place, surface_features
from benchmarks.report import Options, Report, Table, log

FIRST = 6
"""Strikes to begin with."""
ROUNDS = (8, 11, 15, 20)
"""Strikes after each round, when all ways are judged."""
JUDGING = 3
"""One strike of so many is kept to judge by, drawn at random."""
STARTS = 3
"""First strikes, spread evenly over the table."""
WAYS = ("suggested", "farthest", "random")
SIM20_OBJECTS = ("plate-ceramic", "mug-ceramic", "bracket-steel", "blob-polycarbonate")
CONVENTIONS = (
    f"error: relative STFT error, mean over one of {JUDGING} recordings, drawn with seed 0, of which no way learns; "
    "all kernel families, no steps end to end, modes extracted and the field fitted anew for every number of strikes.",
    f"all ways begin with the same {FIRST} strikes, spread as far apart as they go; then some more at a time, of those "
    "recorded: those that suggest names, the farthest from all others, or any (seed: the start's number).",
    "ratio: mean error of suggested strikes over that of farthest ones, all numbers and starts together.",
)


def measure(options: Options) -> Report:
    """Return all ways' errors on the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _aircraft(options: Options) -> Report:
    return _compare("aircraft", {"aircraft_response": capture_in_place("aircraft_response")}, 0.0, options)


def _sim20(options: Options) -> Report:
    names = SIM20_OBJECTS[:1] if options.quick_look else SIM20_OBJECTS
    captures = {}
    for name in names:
        log(f"suggest.sim20: simulating {name}")
        captures[name] = simulate_object(named_recipe(name), name=name).capture
    return _compare("sim20", captures, None, options)


def _compare(key: str, captures: dict[str, Capture], wall: float | None, options: Options) -> Report:
    rows: list[list[str | float]] = []
    found: list[tuple[float, ...]] = []
    for name, capture in captures.items():
        assert capture.surface is not None
        features = surface_features(capture)
        judging = torch.randperm(len(capture.impacts), generator=torch.Generator().manual_seed(0))
        judging = judging[: len(judging) // JUDGING].sort().values
        test = capture.impacts.take(judging.tolist())
        pool = capture.impacts.take(sorted(set(range(len(capture.impacts))) - set(judging.tolist())))
        alignment = None if pool.before is None else align(pool)
        if alignment is not None:
            pool, test = alignment.apply(pool), alignment.apply(test)
        with tempfile.TemporaryDirectory() as cache:
            bodies = candidate_bodies(capture.surface, BodyConfig(wall=wall), cache=Path(cache))
            estimator = MixtureEstimator(bodies=bodies)
            for number in range(1 if options.quick_look else STARTS):
                for count, errors in _paths(pool, test, features, estimator, number, options):
                    rows.append([f"{name}, start {number}", count, *errors])
                    found.append(errors)
                    words = ", ".join(f"{way} {error:.3f}" for way, error in zip(WAYS, errors, strict=True))
                    log(f"suggest.{key}: {name}, start {number}, {count} strikes: {words}")
    means = dict(zip(WAYS, (sum(each) / len(found) for each in zip(*found, strict=True)), strict=True))
    figures = {f"suggest.{key}.{way}": value for way, value in means.items()}
    ratio = means["suggested"] / means["farthest"]
    title = f"suggest.{key}: error with suggested strikes over that with farthest ones {ratio:.3f}"
    return Report(
        tables=(Table(title, ("object", "strikes", *WAYS), rows),), figures={f"suggest.{key}": ratio, **figures}
    )


def _paths(
    pool: Impacts, test: Impacts, features: FeatureField, estimator: MixtureEstimator, number: int, options: Options
) -> list[tuple[int, tuple[float, ...]]]:
    """Return the numbers of strikes with the errors of each way."""
    rounds = [count for count in ROUNDS[: 1 if options.quick_look else None] if count <= len(pool)]
    farthest = farthest_points(pool.contacts, rounds[-1], start=number * len(pool) // STARTS).tolist()
    drawn = torch.randperm(len(pool), generator=torch.Generator().manual_seed(number)).tolist()
    anywhere = farthest[:FIRST] + [row for row in drawn if row not in farthest[:FIRST]]
    rows, found = farthest[:FIRST], []
    suggested = _fitted(pool, rows, features, estimator)
    for count in rounds:
        following = suggest(suggested, count - len(rows), candidates=pool.contacts, directions=pool.directions)
        rows = [*rows, *following.rows.tolist()]
        suggested = _fitted(pool, rows, features, estimator)
        others = (_fitted(pool, each[:count], features, estimator) for each in (farthest, anywhere))
        errors = tuple(evaluate(each, test).mean()["relative_stft"] for each in (suggested, *others))
        found.append((count, errors))
    return found


def _fitted(impacts: Impacts, rows: list[int], features: FeatureField, estimator: MixtureEstimator) -> SoundField:
    train = impacts.take(rows)
    return fit(train, features, extract_modes(train), FitConfig(steps=0), gains=estimator)


PARTS: dict[str, Callable[[Options], Report]] = {"aircraft": _aircraft, "sim20": _sim20}
