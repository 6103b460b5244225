"""Time and memory that a fit with elastic mode shapes takes, and how often its intervals hold the true gains."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from avmsf.capture import read_capture, write_capture
from avmsf.evaluation.splits import split
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.fem.material import NOMINAL, material_named
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.bodies import make_body
from avmsf.simulate.recipe import SIM20, named_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.objects import SplitCase, bodies_of, features_of, surface_of
from benchmarks.processes import apart, peak_gigabytes, processor_seconds, timed
from benchmarks.records import Measurement, Record, Settings, means, records

COSTED = "skillet-iron"
COSTED_SIZE, COSTED_MODES = 0.5, 170
"""Meters, and elastic modes to simulate: so its 8 recordings hold 128 modes and more, of which 128 are kept."""
COVERED = ("mug-ceramic", "bowl-glass", "bracket-steel", "pot-steel", "dish-ceramic", "spoon-wood")
COMPARED = 8
"""Lowest frequencies of nominal bodies and true ones."""


def _cost(settings: Settings) -> Iterator[Record]:
    """From 8 recordings and the mesh of sim-20's skillet-iron, .5 m long, to a field, in a process of its own.

    Bodies of several thicknesses or, filled, of the one that the mesh encloses; modes; fit end to end. cached: again,
    with the elastic shapes kept. gigabytes: peak memory of that process. render_ms: of one sound, after the first.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / COSTED
        recipe = replace(named_recipe(COSTED), size=COSTED_SIZE, elastic_modes=COSTED_MODES)
        made = simulate_object(recipe, name=COSTED)
        train, _ = split(made.capture.impacts, 0.2)
        write_capture(replace(made.capture, impacts=train), folder)
        for name, wall in (("unknown", None), ("filled", 0.0)):
            cache = Path(temporary) / name
            for kept in ("", ".cached"):
                taken = apart(fit_cost, folder, cache, wall, 5000 if settings.quick else 40_000)
                yield from records(taken, group=name + kept)


def fit_cost(folder: Path, cache: Path, wall: float | None, dofs: int) -> dict[str, float]:
    """Return what a fit takes, after the reading of the capture."""
    capture = read_capture(folder)
    begun = time.perf_counter()
    config = BodyConfig(wall=wall, dofs=dofs)
    bodies = candidate_bodies(surface_of(capture), config, impacts=capture.impacts, cache=cache)
    solved = time.perf_counter()
    modes = extract_modes(capture.impacts)
    estimator = MixtureEstimator(bodies=bodies)
    field = fit(capture.impacts, features_of(capture), modes, FitConfig(), gains=estimator)
    done = time.perf_counter()
    field.render(capture.impacts.contacts[:1])
    _, rendering = timed(lambda: field.render(capture.impacts.contacts[:1]))
    return {
        "bodies_seconds": solved - begun,
        "fit_seconds": done - solved,
        "seconds": done - begun,
        "gigabytes": peak_gigabytes(),
        "render_ms": 1e3 * rendering,
        "modes": len(modes.bank),
        "dofs": dofs,
    }


def _coverage(settings: Settings) -> Iterator[Record]:
    """Part of the held-out gains in their intervals of 90 %: 32 impacts with each object where 8 were learnt from.

    by_energy: weighted by their energy; error: relative STFT error there.
    """
    rows = []
    for name in settings.some(COVERED):
        capture = simulate_object(named_recipe(name), name=name).capture
        bodies = bodies_of(surface_of(capture), settings)
        case = SplitCase.of(*split(capture.impacts, 0.2), capture, bodies)
        config = FitConfig(steps=2) if settings.quick else FitConfig()
        field = fit(case.train, case.features, case.modes, config, gains=MixtureEstimator(bodies=bodies))
        plain, by_energy = case.coverage(field)
        rows.append({"coverage90": plain, "coverage90_by_energy": by_energy, "error": case.error(field)})
        yield from records(rows[-1], object=name)
    yield from records(means(rows), group="mean")


def _frequencies(settings: Settings) -> Iterator[Record]:
    """Relative errors of the 8 lowest frequencies of the body that the mesh encloses, scaled to the true material.

    The objects of sim-20 have uneven walls and stiffness of their own and stand on soft supports; 40,000 degrees of
    freedom. seconds: of processor time.
    """
    rows = []
    for name, recipe in settings.some(list(SIM20.items())):
        true = make_body(replace(recipe, elastic_modes=COMPARED), cache=None, log=lambda message: None)
        dofs, messages = 5000 if settings.quick else 40_000, list[str]()
        begun = processor_seconds()
        made = CandidateBodies(true.surface, thicknesses=[None], count=COMPARED, dofs=dofs, log=messages.append)
        modes = made.bodies[0].elastic
        taken, material = processor_seconds() - begun, material_named(recipe.material)
        speed = (material.young / material.density * NOMINAL.density / NOMINAL.young) ** 0.5
        error = modes.frequency * speed / true.elastic.frequency - 1.0
        rows.append({"largest": float(error.abs().max()), "mean": float(error.mean()), "seconds": taken})
        yield from records(rows[-1], object=name, note="; ".join(messages[-1:]))
    yield from records({"mean_error": means(rows)["largest"], "worst_error": max(row["largest"] for row in rows)})


PARTS: dict[str, Measurement] = {"cost": _cost, "coverage": _coverage, "frequencies": _frequencies}
