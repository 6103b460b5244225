"""Time and memory that a fit with elastic mode shapes takes, and how often its intervals hold the true gains."""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from avmsf.capture import read_capture, write_capture
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.fem.material import NOMINAL, material_named
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.posterior import coverage
from avmsf.modal.extraction.extract import extract_modes
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.simulate.bodies import make_body
from avmsf.simulate.recipe import SIM20, named_recipe
from avmsf.simulate.simulation import simulate_object
from benchmarks.field import measured_gains
from benchmarks.material import surface_features
from benchmarks.report import Options, Report, Table, log
from benchmarks.scans import processor_seconds, scans
from benchmarks.step import peak_gigabytes

COSTED = "skillet-iron"
COSTED_SIZE, COSTED_MODES = 0.5, 170
"""Meters, and elastic modes to simulate: so its 8 recordings hold 128 modes and more, of which 128 are kept."""
COVERED = ("mug-ceramic", "bowl-glass", "bracket-steel", "pot-steel", "dish-ceramic", "spoon-wood")
COMPARED = 8
"""Lowest frequencies of nominal bodies and true ones."""
CONVENTIONS = (
    f"physics.seconds: of sim-20's {COSTED}, {COSTED_SIZE:g} m long, 8 recordings of it, from a mesh of unknown wall "
    "to a field: bodies of several walls, the most probable one with 40,000 degrees of freedom, modes, fit end to end, "
    "in a process of its own; seconds_cached: again, with the elastic shapes kept; filled: the same where it is told "
    "that the mesh encloses the material whole, which it does. gigabytes: peak memory of that process. render_ms: of "
    "one sound, after the first.",
    "coverage90: part of the held-out recordings' own gains in the 90 % interval, of 32 blows with each of "
    "six objects of sim-20 where 8 were learnt from; by_energy: by their energy; error: relative STFT error there.",
    f"frequency_error: largest relative error of the {COMPARED} lowest frequencies of the body that the mesh encloses, "
    "40,000 degrees of freedom, scaled to the true material; mean over the objects of sim-20, whose own walls and "
    "stiffness are uneven and which stand on soft supports.",
)


def measure(options: Options) -> Report:
    """Return the figures of the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _cost(options: Options) -> Report:
    """Fit in processes of their own: with nothing kept, with the shapes kept, and likewise with a wall given."""
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / COSTED
        recipe = replace(named_recipe(COSTED), size=COSTED_SIZE, elastic_modes=COSTED_MODES)
        made = simulate_object(recipe, name=COSTED)
        train, _ = split(made.capture.impacts, 0.2)
        write_capture(replace(made.capture, impacts=train), folder)
        for name, wall in (("", "unknown"), (".filled", "0")):
            cache = Path(temporary) / f"kept{name}"
            for kept in ("", "_cached"):
                taken = _in_a_process(folder, cache, wall, options)
                figures |= {
                    f"physics{name}.seconds{kept}": taken["seconds"],
                    f"physics{name}.gigabytes{kept}": taken["gigabytes"],
                }
                words = f"{'filled' if name else 'wall unknown'}, {'kept shapes' if kept else 'nothing kept'}"
                values = [taken[each] for each in ("bodies", "fit", "seconds", "gigabytes", "modes", "dofs")]
                rows.append([words, *values])
                log(f"physics.cost: {words}: {taken['seconds']:.0f} s")
        figures["physics.render_ms"] = taken["render_ms"]
    title = f"{COSTED}, 8 recordings; a sound is rendered in {taken['render_ms']:.1f} ms"
    columns = ("", "s for bodies", "s for modes and fit", "s", "GB", "modes", "degrees of freedom asked")
    return Report(tables=(Table(title, columns, rows),), figures=figures)


def _in_a_process(folder: Path, cache: Path, wall: str, options: Options) -> dict[str, Any]:
    """Return what `_fitted` prints in a fresh process, whose memory and caches are its own."""
    dofs = "3000" if options.quick_look else "40000"
    command = [sys.executable, "-m", "benchmarks.physics", str(folder), str(cache), wall, dofs]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def _fitted(folder: Path, cache: Path, wall: str, dofs: int) -> dict[str, float]:
    """Return how long a fit takes, beside the reading of the capture, and what it takes it with."""
    capture = read_capture(folder)
    assert capture.surface is not None
    begun = time.perf_counter()
    config = BodyConfig(wall=None if wall == "unknown" else float(wall), dofs=dofs)
    bodies = candidate_bodies(capture.surface, config, impacts=capture.impacts, cache=cache)
    solved = time.perf_counter()
    modes = extract_modes(capture.impacts)
    estimator = MixtureEstimator(bodies=bodies)
    field = fit(capture.impacts, surface_features(capture), modes, FitConfig(), gains=estimator)
    done = time.perf_counter()
    field.render(capture.impacts.contacts[:1])
    warm = time.perf_counter()
    field.render(capture.impacts.contacts[:1])
    return {
        "bodies": solved - begun,
        "fit": done - solved,
        "seconds": done - begun,
        "render_ms": 1e3 * (time.perf_counter() - warm),
        "gigabytes": peak_gigabytes(),
        "modes": float(len(modes.bank)),
        "dofs": float(dofs),
    }


def _coverage(options: Options) -> Report:
    """Predict the gains of 32 impacts on each object from those of 8."""
    rows: list[list[str | float]] = []
    for name in COVERED[:1] if options.quick_look else COVERED:
        made = simulate_object(named_recipe(name), name=name)
        assert made.capture.surface is not None
        train, test = split(made.capture.impacts, 0.2)
        config = BodyConfig(dofs=3000) if options.quick_look else BodyConfig()
        with tempfile.TemporaryDirectory() as cache:
            estimator = MixtureEstimator(bodies=candidate_bodies(made.capture.surface, config, cache=Path(cache)))
            steps = FitConfig(steps=2) if options.quick_look else FitConfig()
            modes = extract_modes(train)
            field = fit(train, surface_features(made.capture), modes, steps, gains=estimator)
            test = modes.aligned(test)
        held = coverage(field, test.contacts, measured_gains(test, field), directions=test.directions, level=0.9)
        rows.append([name, held.plain, held.by_energy, evaluate(field, test).mean()["relative_stft"]])
        log(f"physics.coverage: {name}: {held.plain:.3f}, by energy {held.by_energy:.3f}, error {rows[-1][3]:.3f}")
    plain, by_energy, error = torch.tensor([[float(value) for value in row[1:]] for row in rows]).mean(0).tolist()
    figures = {"physics.coverage90": plain, "physics.coverage90_by_energy": by_energy, "physics.sim20.error": error}
    columns = ("object", "coverage90", "by energy", "error")
    return Report(
        tables=(Table(f"intervals of 90 % on {len(rows)} objects of sim-20, 8 blows learnt from", columns, rows),),
        figures=figures,
    )


def _frequencies(options: Options) -> Report:
    """Compare the lowest frequencies of nominal bodies, made of what the mesh encloses, with the true ones."""
    rows: list[list[str | float]] = []
    for name, recipe in list(SIM20.items())[: 1 if options.quick_look else None]:
        true = make_body(replace(recipe, elastic_modes=COMPARED), cache=None, log=lambda words: None)
        dofs = 3000 if options.quick_look else 40_000
        heard: list[str] = []
        begun = processor_seconds()
        made = SurfaceBodies(true.surface, thicknesses=[None], count=COMPARED, dofs=dofs, log=heard.append)
        taken, material = processor_seconds() - begun, material_named(recipe.material)
        speed = (material.young / material.density * NOMINAL.density / NOMINAL.young) ** 0.5
        error = made.bodies[0].elastic.frequency * speed / true.elastic.frequency - 1.0
        rows.append([name, float(error.abs().max()), float(error.mean()), taken, "; ".join(heard[-1:])])
        log(f"physics.frequencies: {name}: {rows[-1][1]:.3f}, {taken:.0f} s")
    figures = {
        "physics.frequency_error": sum(float(row[1]) for row in rows) / len(rows),
        "physics.largest_frequency_error": max(float(row[1]) for row in rows),
    }
    title = f"{COMPARED} lowest frequencies of filled meshes of sim-20 against the true objects'"
    return Report(
        tables=(Table(title, ("object", "largest error", "mean error", "CPU s", "last step"), rows),), figures=figures
    )


PARTS: dict[str, Callable[[Options], Report]] = {
    "cost": _cost,
    "coverage": _coverage,
    "frequencies": _frequencies,
    "scans": scans,
}

if __name__ == "__main__":
    print(json.dumps(_fitted(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))))
