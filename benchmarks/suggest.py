"""Whether strikes where `suggest` says are worth more than strikes spread as far apart as they go."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from avmsf.bench.evaluation import evaluate
from avmsf.capture import Capture, Impacts
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.physics import Physics
from avmsf.field.soundfield import SoundField
from avmsf.field.suggest import suggest
from avmsf.modal.extract import extract
from avmsf.pipeline.physics import BodyConfig, physics_of
from avmsf.scene.features import FeatureField
from avmsf.scene.points import farthest_points
from avmsf.simulate.sim20 import sim20_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.material import capture_in_place, surface_features
from benchmarks.report import Options, Report, Table, tell

FIRST = 6
"""Strikes to begin with."""
ROUNDS = (8, 10, 12, 14, 17, 20)
"""Strikes after each round, when both ways are judged."""
STARTS = 3
"""First strikes, spread evenly over the table."""
SIM20_OBJECTS = ("plate-ceramic", "mug-ceramic", "skillet-iron", "blob-polycarbonate")
CONVENTIONS = (
    "error: relative STFT error, mean over the recordings that neither way has learnt from; physics, no steps end to "
    "end, modes extracted and the field fitted anew for every number of strikes.",
    f"both ways begin with the same {FIRST} strikes, spread as far apart as they go; then some more at a time, of "
    "those recorded: the farthest from all others, or those that suggest names; after each round both are judged.",
    "ratio: mean error of suggested strikes over that of farthest ones, all numbers and starts together.",
)


def measure(options: Options) -> Report:
    """Return both ways' errors on the chosen parts."""
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
        tell(f"suggest.sim20: simulating {name}")
        captures[name] = simulate_object(sim20_recipe(name), name=name).capture
    return _compare("sim20", captures, None, options)


def _compare(key: str, captures: dict[str, Capture], wall: float | None, options: Options) -> Report:
    rows: list[list[str | float]] = []
    suggested, farthest = [], []
    for name, capture in captures.items():
        assert capture.surface is not None
        features = surface_features(capture)
        with tempfile.TemporaryDirectory() as cache:
            recipe = physics_of(capture.surface, BodyConfig(wall=wall), cache=Path(cache))
            starts = [number * len(capture.impacts) // STARTS for number in range(1 if options.quick_look else STARTS)]
            for start in starts:
                for count, ours, others in _paths(capture.impacts, features, recipe, start, options):
                    rows.append([f"{name}, start {start}", count, ours, others])
                    suggested.append(ours)
                    farthest.append(others)
                    tell(f"suggest.{key}: {name}, start {start}, {count} strikes: {ours:.3f} and {others:.3f}")
    ratio = sum(suggested) / sum(farthest)
    figures = {
        f"suggest.{key}": ratio,
        f"suggest.{key}.suggested": sum(suggested) / len(suggested),
        f"suggest.{key}.farthest": sum(farthest) / len(farthest),
    }
    title = f"suggest.{key}: error with suggested strikes over that with farthest ones {ratio:.3f}"
    return Report(tables=(Table(title, ("object", "strikes", "suggested", "farthest"), rows),), figures=figures)


def _paths(
    impacts: Impacts, features: FeatureField, recipe: Physics, start: int, options: Options
) -> list[tuple[int, float, float]]:
    """Return the numbers of strikes with the errors of suggested and of farthest ones."""
    rounds = ROUNDS[:1] if options.quick_look else ROUNDS
    farthest = farthest_points(impacts.contacts, rounds[-1], start=start).tolist()
    rows, found = farthest[:FIRST], []
    ours = _fitted(impacts, rows, features, recipe)
    for count in rounds:
        following = suggest(ours, count - len(rows), candidates=impacts.contacts, directions=impacts.directions)
        rows, others = [*rows, *following.rows.tolist()], farthest[:count]
        test = impacts.take(sorted(set(range(len(impacts))) - set(rows) - set(others)))
        ours, spread = (_fitted(impacts, each, features, recipe) for each in (rows, others))
        errors = [evaluate(each, test).mean()["relative_stft"] for each in (ours, spread)]
        found.append((count, errors[0], errors[1]))
    return found


def _fitted(impacts: Impacts, rows: list[int], features: FeatureField, recipe: Physics) -> SoundField:
    train = impacts.take(rows)
    return fit(train, features, extract(train), FitConfig(steps=0), gains=recipe)


PARTS: dict[str, Callable[[Options], Report]] = {"aircraft": _aircraft, "sim20": _sim20}
