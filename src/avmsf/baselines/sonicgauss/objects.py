"""Simulated objects that the small SonicGauss is trained on: none of them is in sim-20."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.caching import key_of, source_digest
from avmsf._utils.state import read_checkpoint, write_checkpoint
from avmsf.baselines.sonicgauss.small import SmallConfig, object_tokens, visible
from avmsf.errors import EvaluationError, SceneError, SimulationError
from avmsf.fem.material import MATERIALS
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import splat
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.shapes.kinds import KINDS
from avmsf.simulate.sim20 import SIM20
from avmsf.simulate.simulation import simulate_object

FIRST_SEED = 1001
"""Seed of the first object; those of sim-20 are 1 to 20."""
SPLAT = SplatConfig(steps=300, degree=1, start_points=3000, gaussians=4000, halvings=1)
"""A twentieth of the work of the default: 24 small views show where an object is and roughly how it looks."""
_AZIMUTHS, _PIXELS = 8, 96
_FIELDS = ("centers", "rotations", "log_scales", "logit_opacities", "harmonics")


@dataclass(frozen=True, eq=False)
class TrainingObject:
    """Gaussians of an object, and its recordings."""

    cloud: GaussianCloud
    contacts: Float[Tensor, "contacts 3"]
    """Meters."""
    sounds: Float[Tensor, "contacts samples"]
    sample_rate: float
    """Hz."""


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


def training_objects(
    recipes: Sequence[ObjectRecipe], *, cache: Path | None = None, log: Callable[[str], None] | None = None
) -> Iterator[TrainingObject]:
    """Yield the objects of recipes, kept in files beneath `cache` where it is given.

    An object that cannot be simulated or splatted is left out, and `log` is called with the reason.
    """
    for number, recipe in enumerate(recipes, 1):
        name = f"{number} of {len(recipes)}, {recipe.kind}-{recipe.material}"
        path = None if cache is None else cache / f"{recipe.kind}-{recipe.seed}-{key_of(_identity(recipe))}.pt"
        try:
            found = None if path is None else _kept(path, recipe)
            made = found or _made(recipe)
            # What training reads of it.
            object_tokens(visible(made.cloud), count=SmallConfig().tokens)
        except (SimulationError, SceneError, EvaluationError) as error:
            if log is not None:
                log(f"{name} is left out: {error}")
            continue
        if path is not None and found is None:
            _keep(path, recipe, made)
        if log is not None:
            log(f"{name}: {len(made.cloud)} Gaussians")
        yield made


def _made(recipe: ObjectRecipe) -> TrainingObject:
    simulation = simulate_object(recipe)
    cameras = orbit_cameras(simulation.mesh.surface, size=_PIXELS, azimuths=_AZIMUTHS)
    cloud = splat(render_views(simulation.mesh, cameras), replace(SPLAT, seed=recipe.seed))
    impacts = simulation.capture.impacts
    return TrainingObject(cloud, impacts.contacts.float(), impacts.sounds, impacts.sample_rate)


def _identity(recipe: ObjectRecipe) -> dict[str, str]:
    return {"recipe": key_of(recipe.values()), "splatting": repr(SPLAT), "source": source_digest(__name__)}


def _keep(path: Path, recipe: ObjectRecipe, made: TrainingObject) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {name: getattr(made.cloud, name) for name in _FIELDS}
    state |= {"contacts": made.contacts, "sounds": made.sounds, "sample_rate": made.sample_rate}
    write_checkpoint(path, state, _identity(recipe), raising=EvaluationError)


def _kept(path: Path, recipe: ObjectRecipe) -> TrainingObject | None:
    state = read_checkpoint(path, _identity(recipe), what="a training object", raising=EvaluationError)
    if state is None:
        return None
    cloud = GaussianCloud(*(state[name] for name in _FIELDS))
    return TrainingObject(cloud, state["contacts"], state["sounds"], float(state["sample_rate"]))
