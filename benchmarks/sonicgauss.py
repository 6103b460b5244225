"""The small SonicGauss: its training from scratch, by one command, on simulated objects, none of which is in sim-20.

`python -m benchmarks.sonicgauss evaluate ...` is `avmsf evaluate ...` with the method `sonicgauss-small:FILE`.
"""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from avmsf.baselines.sonicgauss.training import TrainingConfig
from avmsf.capture.impacts import Impacts
from avmsf.cli import main
from avmsf.errors import EvaluationError, SceneError, SimulationError
from avmsf.fem.material import MATERIALS
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import splat
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from avmsf.simulate.recipe import SIM20, ObjectRecipe
from avmsf.simulate.shapes.catalog import KINDS
from avmsf.simulate.simulation import simulate_object
from benchmarks.records import Record, Settings, records
from benchmarks.small_sonicgauss import SmallConfig, object_tokens, train_small, visible

OBJECTS = 40
"""Simulated objects, 32 recordings each."""
_QUICK = SmallConfig(blocks=1, encoder_blocks=1), TrainingConfig(steps=4, batch=8, rate=1e-3)
FIRST_SEED = 1001
"""Seed of the first object; those of sim-20 are 1 to 20."""
SPLAT = SplatConfig(steps=300, degree=1, start_points=3000, gaussians=4000, halvings=1)
"""A twentieth of the work of the default: 24 small views show where an object is and roughly how it looks."""
_AZIMUTHS, _PIXELS = 8, 96
PRETRAINING = TrainingConfig(steps=1000, batch=24, rate=1e-3, warmup=100)
"""A quarter of an hour on one core."""


def training_recipes(count: int, *, seed: int = 0, contacts: int = 32) -> tuple[ObjectRecipe, ...]:
    """Return recipes of `count` objects, all kinds of shapes in turn, each of a random material.

    No object has the seed, and therefore the proportions, of one of sim-20, nor its kind and material.
    """
    generator = np.random.default_rng(seed)
    kinds, taken = sorted(KINDS), {(recipe.kind, recipe.material) for recipe in SIM20.values()}
    recipes = []
    for number in range(count):
        kind = kinds[number % len(kinds)]
        materials = [material for material in MATERIALS if (kind, material) not in taken]
        material = materials[generator.integers(len(materials))]
        start = FIRST_SEED + number + 10_000 * seed
        recipes.append(ObjectRecipe(kind=kind, material=material, seed=start, impacts=contacts, views=0))
    return tuple(recipes)


def training_objects(recipes: Sequence[ObjectRecipe]) -> Iterator[tuple[GaussianCloud, Impacts]]:
    """Yield the Gaussians and the recordings of recipes' objects.

    An object that cannot be simulated or splatted is left out, and the reason is told.
    """
    for recipe in recipes:
        try:
            simulation = simulate_object(recipe)
            cameras = orbit_cameras(simulation.mesh.surface, size=_PIXELS, azimuths=_AZIMUTHS)
            cloud = splat(render_views(simulation.mesh, cameras), replace(SPLAT, seed=recipe.seed))
            # What training reads of it.
            object_tokens(visible(cloud), count=SmallConfig().tokens)
        except (SimulationError, SceneError, EvaluationError) as error:
            print(f"{recipe.kind}-{recipe.material} is left out: {error}", file=sys.stderr)
            continue
        yield cloud, simulation.capture.impacts


def training(settings: Settings) -> Iterator[Record]:
    """Make the weights of sonicgauss-small in the work folder: mean losses of the parts of training, in order.

    seconds: of processor time, for making the objects and for training.
    """
    sizes, config = _QUICK if settings.quick else (SmallConfig(), PRETRAINING)
    begun = time.process_time()
    objects = list(training_objects(training_recipes(2 if settings.quick else OBJECTS)))
    made = time.process_time() - begun
    found = train_small(objects, sizes, config)
    trained = time.process_time() - begun - made
    settings.kept.mkdir(parents=True, exist_ok=True)
    found.write(settings.weights)
    losses = found.report["losses"]
    for number, loss in enumerate(losses, 1):
        yield from records({"loss": loss}, group=f"{number / len(losses):.0%} of the steps")
    yield from records({"objects_seconds": made, "training_seconds": trained})


if __name__ == "__main__":
    sys.exit(main())
