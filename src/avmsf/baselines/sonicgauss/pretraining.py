"""Training of the small SonicGauss from scratch, on simulated objects, none of which is in sim-20."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.caching import key_of, source_digest
from avmsf._utils.state import read_checkpoint, write_checkpoint
from avmsf.baselines.sonicgauss.patches import PatchCodec, log_magnitudes, spectra
from avmsf.baselines.sonicgauss.small import SmallConfig, SmallSonicGauss, SmallWeights, object_tokens, visible
from avmsf.baselines.sonicgauss.training import DROPPED, TrainingConfig, flow_loss, train
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


_LOG_EVERY = 25
"""Steps between words of progress."""
_CURVE = 20
"""Points of the loss curve that is kept."""


@dataclass(frozen=True)
class PretrainingConfig:
    """Sizes and schedule; the defaults take a quarter of an hour on one core."""

    network: SmallConfig = field(default_factory=SmallConfig)
    training: TrainingConfig = field(
        default_factory=lambda: TrainingConfig(steps=1000, batch=24, rate=1e-3, warmup=100)
    )


def pretrain(
    objects: Iterable[TrainingObject],
    config: PretrainingConfig | None = None,
    *,
    seed: int = 0,
    log: Callable[[str], None] | None = None,
) -> SmallWeights:
    """Train on objects' recordings. Raises EvaluationError where there is no object."""
    config = PretrainingConfig() if config is None else config
    begun = time.process_time()
    tokens, places, logs = [], [], []
    for each in objects:
        seen = visible(each.cloud)
        found = spectra(each.sounds, each.sample_rate)
        tokens.append(object_tokens(seen, count=config.network.tokens))
        places.append(seen.places(each.contacts))
        logs.append(log_magnitudes(found, float(found.abs().max())))
    if not tokens:
        raise EvaluationError(
            "expected objects to train on, got none; make them with `training_objects`", name="objects", value=0
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SmallSonicGauss(config.network)
    features = torch.stack(tokens)
    network.mean.copy_(features.mean((0, 1)))
    network.deviation.copy_(features.std((0, 1)).clamp(min=1e-3))
    codec = PatchCodec.of(logs, seed=seed)
    owners = torch.cat([torch.full((len(each),), row) for row, each in enumerate(places)])
    clips = _Clips(features, owners, torch.cat(places), torch.cat([codec.encode(each) for each in logs]))
    logs.clear()

    def say(step: int, loss: float) -> None:
        if log is not None and step % _LOG_EVERY == 0:
            log(f"step {step} of {config.training.steps}: loss {loss:.4f}, {time.process_time() - begun:.0f} s")

    losses = train(network.parameters(), clips.loss(network.train()), len(owners), config.training, seed=seed, log=say)
    report = {
        "objects": len(tokens),
        "clips": len(owners),
        "steps": config.training.steps,
        "batch": config.training.batch,
        "seed": seed,
        "losses": [round(value, 4) for value in _means(losses, _CURVE)],
        "seconds": round(time.process_time() - begun, 1),
    }
    return SmallWeights(network.eval(), codec, report)


@dataclass(frozen=True, eq=False)
class _Clips:
    """What the loss is computed of, a row for each recording."""

    features: Float[Tensor, "objects tokens 23"]
    owners: Int[Tensor, " clips"]
    places: Float[Tensor, "clips 3"]
    latents: Float[Tensor, "clips patches channels"]

    def loss(self, network: SmallSonicGauss) -> Callable[[Int[Tensor, " batch"], torch.Generator], Tensor]:
        """Return the loss of a network by rows."""

        def of(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Tensor:
            return clip_loss(
                network, self.features[self.owners[rows]], self.places[rows], self.latents[rows], generator=generator
            )

        return of


def clip_loss(
    network: SmallSonicGauss,
    features: Float[Tensor, "batch tokens 23"],
    places: Float[Tensor, "batch 3"],
    latents: Float[Tensor, "batch patches channels"],
    *,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Return the flow's loss, a tenth of the conditions zeroed."""
    kept = torch.rand(len(latents), 1, 1, generator=generator) >= DROPPED
    tokens = network.condition(features, places) * kept
    return flow_loss(lambda state, times: network(state, times, tokens), latents, generator=generator)


def _means(values: list[float], count: int) -> list[float]:
    """Return means over at most `count` equal spans."""
    span = max(1, len(values) // count)
    return [sum(values[start : start + span]) / span for start in range(0, span * (len(values) // span), span)]
