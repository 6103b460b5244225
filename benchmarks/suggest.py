"""Whether impacts where `suggest` says are worth more than impacts spread as far apart as they go."""

from collections.abc import Iterator, Mapping

import torch

from avmsf.capture import Capture, Impacts
from avmsf.evaluation.scores import evaluate
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.next_contacts import suggest
from avmsf.field.sound_field import SoundField
from avmsf.mesh.points import farthest_points
from avmsf.modal.extraction.alignment import align
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.recipe import named_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.objects import features_of, measured, settings_of, surface_of
from benchmarks.records import Measurement, Record, Settings, means, records

FIRST, ROUNDS = 6, (8, 11, 15, 20)
"""Impacts to begin with, and after each round, when all ways are compared."""
HELD_OUT, STARTS = 3, 3
"""One recording of so many is held out, drawn at random; and first contacts, spread evenly over the table."""
SIM20_OBJECTS = ("plate-ceramic", "mug-ceramic", "bracket-steel", "blob-polycarbonate")


def _aircraft(settings: Settings) -> Iterator[Record]:
    """Relative STFT error, mean over one of 3 recordings, drawn with seed 0, of which no way learns.

    All kernel families, no steps end to end, modes extracted and the field fitted for every number of impacts. All
    ways begin with the same 6 impacts, spread as far apart as they go; then some more at a time, of those recorded:
    those that suggest names, the farthest from all others, or any (seed: the start's number). ratio: mean error of
    suggested contacts over that of farthest ones, all numbers and starts together.
    """
    aircraft = measured("aircraft_response", settings_of("aircraft_response"))
    return _compare({"aircraft_response": aircraft}, 0.0, settings)


def _sim20(settings: Settings) -> Iterator[Record]:
    """The same on four simulated objects of unknown thickness."""
    names = settings.some(SIM20_OBJECTS)
    return _compare({name: simulate_object(named_recipe(name), name=name).capture for name in names}, None, settings)


def _compare(captures: Mapping[str, Capture], wall: float | None, settings: Settings) -> Iterator[Record]:
    found = []
    for name, capture in captures.items():
        features, count = features_of(capture), len(capture.impacts)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(0)).tolist()
        test = capture.impacts.take(sorted(order[: count // HELD_OUT]))
        pool = capture.impacts.take(sorted(order[count // HELD_OUT :]))
        alignment = None if pool.before is None else align(pool)
        if alignment is not None:
            pool, test = alignment.apply(pool), alignment.apply(test)
        estimator = MixtureEstimator(bodies=candidate_bodies(surface_of(capture), BodyConfig(wall=wall)))
        for number in settings.some(range(STARTS)):
            for contacts, fields in _paths(pool, features, estimator, number, settings):
                found.append({way: evaluate(each, test).mean()["relative_stft"] for way, each in fields.items()})
                yield from records(found[-1], group=f"start {number}, {contacts} contacts", object=name)
    mean = means(found)
    yield from records(mean | {"ratio": mean["suggested"] / mean["farthest"]}, group="mean")


def _paths(
    pool: Impacts, features: FeatureField, estimator: MixtureEstimator, number: int, settings: Settings
) -> Iterator[tuple[int, dict[str, SoundField]]]:
    """Yield the numbers of contacts with the field of each way."""
    rounds = [count for count in settings.some(ROUNDS) if count <= len(pool)]
    farthest = farthest_points(pool.contacts, rounds[-1], start=number * len(pool) // STARTS).tolist()
    drawn = torch.randperm(len(pool), generator=torch.Generator().manual_seed(number)).tolist()
    anywhere = farthest[:FIRST] + [row for row in drawn if row not in farthest[:FIRST]]

    def fitted(rows: list[int]) -> SoundField:
        train = pool.take(rows)
        return fit(train, features, extract_modes(train), FitConfig(steps=0), gains=estimator)

    rows = farthest[:FIRST]
    suggested = fitted(rows)
    for count in rounds:
        following = suggest(suggested, count - len(rows), candidates=pool.contacts, directions=pool.directions)
        rows = [*rows, *following.rows.tolist()]
        suggested = fitted(rows)
        ways = {"suggested": suggested, "farthest": fitted(farthest[:count]), "random": fitted(anywhere[:count])}
        yield count, ways


PARTS: dict[str, Measurement] = {"aircraft": _aircraft, "sim20": _sim20}
