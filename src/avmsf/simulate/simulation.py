"""A recipe in, an object out that was struck and recorded: a capture, its truth, and what it looks like."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.texturedmesh import TexturedMesh
from avmsf.simulate.bodies import Body, make_body, up_of
from avmsf.simulate.imperfections import damping_matrix, stream
from avmsf.simulate.radiation import radiated
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.ringing import ring
from avmsf.simulate.roomnoise import room_noise
from avmsf.simulate.soundingbody import SoundingBody
from avmsf.simulate.strikes import Strikes, draw_strikes
from avmsf.simulate.truth import Truth
from avmsf.simulate.vibration import damped

HIGHEST = 0.45
"""Frequency over the sample rate up to which modes sound: what an ordinary recorder's filter lets pass."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated object."""

    recipe: ObjectRecipe
    capture: Capture
    """Recordings in pascals per newton, contacts and directions as they were written down."""
    truth: Truth
    mesh: TexturedMesh
    body: SoundingBody
    """Gives the gains of any other blow."""


def simulate_object(
    recipe: ObjectRecipe,
    *,
    name: str | None = None,
    cache: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Simulate an object, its blows and its recordings.

    `name` is what the object is called: shape or mesh and material without it. Elastic modes are kept in the folder
    `cache`, where one is given, and found there again by all that decides them. `progress` is told what comes next.
    Raises SimulationError where the recipe describes no object that sounds, and CaptureError for a mesh that cannot be
    read.
    """
    tell = progress or (lambda stage: None)
    body = make_body(recipe, cache=cache, tell=tell)
    tell("sounds")
    sounding = sounding_body(recipe, body)
    strikes = draw_strikes(
        body.surface, recipe.contacts, up=up_of(recipe), imperfections=recipe.imperfections, seed=recipe.seed
    )
    impacts, truth = record(recipe, sounding, strikes)
    return Simulation(recipe, Capture(name or name_of(recipe), impacts, body.surface), truth, body.mesh, sounding)


def name_of(recipe: ObjectRecipe) -> str:
    """Return what an object is called unless told otherwise."""
    return f"{recipe.kind if recipe.mesh is None else recipe.mesh.stem}-{recipe.material.lower()}"


def sounding_body(recipe: ObjectRecipe, body: Body) -> SoundingBody:
    """Return how a body sounds at the recipe's microphone when it is struck with the recipe's hammer."""
    matrix = damping_matrix(
        body.elastic, recipe.imperfections, supports=body.supports, generator=stream(recipe.seed, "coupling")
    )
    vibration = damped(body.elastic.frequency, matrix, highest=HIGHEST * recipe.sample_rate)
    vertices = body.surface.vertices.double()
    microphone = 0.5 * (vertices.amax(0) + vertices.amin(0)) + torch.tensor(recipe.microphone, dtype=torch.float64)
    heard = radiated(body.elastic, vibration, microphone, retardation=recipe.imperfections.retardation)
    return SoundingBody(body.elastic, vibration, heard, recipe.hammer)


def record(recipe: ObjectRecipe, body: SoundingBody, strikes: Strikes) -> tuple[Impacts, Truth]:
    """Record the blows as a recorder does, and divide each recording by the peak force that was written down."""
    forces = body.forces(strikes.speeds)
    written = forces * strikes.force_errors
    amplitudes = body.gains(strikes.places, strikes.directions, speeds=strikes.speeds) / strikes.force_errors[:, None]
    poles = body.vibration.poles
    samples = round(recipe.seconds * recipe.sample_rate)
    sounds = ring(poles, amplitudes, sample_rate=float(recipe.sample_rate), samples=samples)
    sounds = sounds + _noise(recipe, sounds, written)
    names = tuple(f"{row + 1:03d}.wav" for row in range(len(sounds)))
    impacts = Impacts(
        contacts=strikes.written_places,
        sounds=sounds.float(),
        sample_rate=float(recipe.sample_rate),
        names=names,
        directions=strikes.written_directions.float(),
        forces=written.float(),
    )
    truth = Truth(
        frequency=body.vibration.frequency,
        damping=body.vibration.damping,
        gains=-amplitudes.imag,
        quadrature=amplitudes.real.clone(),
        names=names,
        recipe=recipe.values(),
        contacts=strikes.places,
    )
    return impacts, truth


def _noise(
    recipe: ObjectRecipe, sounds: Float64[Tensor, "contacts samples"], forces: Float64[Tensor, " contacts"]
) -> Float64[Tensor, "contacts samples"]:
    """Return the room's noise per newton: one level in the room, and so more of it beneath fainter blows."""
    if recipe.noise_db is None:
        return torch.zeros_like(sounds)
    level = math.sqrt(float((sounds * forces[:, None]).square().mean())) * 10.0 ** (recipe.noise_db / 20.0)
    noise = room_noise(*sounds.shape, sample_rate=float(recipe.sample_rate), generator=stream(recipe.seed, "noise"))
    return level * torch.from_numpy(noise) / forces[:, None]
