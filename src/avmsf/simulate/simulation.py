"""A recipe in, an object out that was struck and recorded: a capture, its truth, and what it looks like."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avmsf.capture.audio import Recording
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.starts import cut_together, shorten
from avmsf.fem.damping import damped
from avmsf.fem.radiated_sound import radiated, travel_time
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.simulate.bodies import Body, make_body, up_of
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.imperfections import damping_matrix, recording_starts, stream
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.ringing import recorded
from avmsf.simulate.room_noise import room_noise
from avmsf.simulate.sounding_body import SoundingBody
from avmsf.simulate.strikes import Strikes, draw_strikes

HIGHEST = 0.45
"""Frequency over the sample rate up to which modes sound: what an ordinary recorder's filter lets pass."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """A simulated object."""

    recipe: ObjectRecipe
    capture: Capture
    """What `read_capture` reads where `write_simulation` wrote this: recordings in pascals per newton, cut at the
    onsets that it finds; contacts and directions as they were written down."""
    recordings: Float32[Tensor, "contacts frames"]
    """The whole recordings, pascals per newton: before each impact there is the room's noise alone."""
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
    log = progress or (lambda stage: None)
    body = make_body(recipe, cache=cache, log=log)
    log("sounds")
    sounding = sounding_body(recipe, body)
    strikes = draw_strikes(
        body.surface, recipe.impacts, up=up_of(recipe), imperfections=recipe.imperfections, seed=recipe.seed
    )
    recordings, forces, truth = record(recipe, sounding, strikes)
    seen = body.surface if recipe.surface else None
    capture = _captured(recipe, recordings, strikes, forces, truth, name=name or name_of(recipe), surface=seen)
    return Simulation(recipe, capture, recordings, truth, body.mesh, sounding)


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
    return SoundingBody(body.elastic, vibration, heard, recipe.hammer, travel_time(body.elastic, microphone))


def record(
    recipe: ObjectRecipe, body: SoundingBody, strikes: Strikes
) -> tuple[Float32[Tensor, "contacts frames"], Float32[Tensor, " contacts"], Truth]:
    """Return the recordings, divided by the peak forces that were written down, these forces, and the truth.

    A recorder runs for `pretrigger` before and after what is asked for, and all recordings are equally long.
    """
    imperfections, rate = recipe.imperfections, float(recipe.sample_rate)
    forces = body.forces(strikes.speeds, strikes.contact_times)
    written = forces * strikes.force_errors
    amplitudes = body.gains(
        strikes.places, strikes.directions, speeds=strikes.speeds, contact_times=strikes.contact_times
    )
    amplitudes = amplitudes / strikes.force_errors[:, None]
    starts = recording_starts(len(amplitudes), imperfections, delay=body.delay, sample_rate=rate, seed=recipe.seed)
    frames = _kept(recipe) + max(0, math.ceil(starts.max())) + round(imperfections.pretrigger * rate)
    sounds = recorded(body.vibration.poles, amplitudes, starts, sample_rate=rate, samples=frames)
    sounds = sounds + _noise(recipe, sounds, written)
    truth = Truth(
        frequency=body.vibration.frequency,
        damping=body.vibration.damping,
        gains=-amplitudes.imag,
        quadrature=amplitudes.real.clone(),
        names=tuple(f"{row + 1:03d}.wav" for row in range(len(sounds))),
        recipe=recipe.values(),
        contacts=strikes.places,
        starts=starts,
    )
    return sounds.float(), written.float(), truth


def _captured(
    recipe: ObjectRecipe,
    recordings: Float32[Tensor, "contacts frames"],
    strikes: Strikes,
    forces: Float32[Tensor, " contacts"],
    truth: Truth,
    *,
    name: str,
    surface: Surface | None,
) -> Capture:
    """Return what reading the written recordings gives. Onsets are found, unless all recordings start with theirs."""
    assert truth.starts is not None
    rate = float(recipe.sample_rate)
    settings = CaptureSettings(
        name=name,
        seconds=_kept(recipe) / recipe.sample_rate,
        normalize="done",
        align=bool((truth.starts != 0.0).any()),
    )
    prepared = []
    for file, force, sound in zip(truth.names, forces.tolist(), recordings, strict=True):
        recording = Recording(file, sound.double().numpy()[None], rate, "FLOAT")
        prepared.append(shorten(prepare(recording, settings, newtons=force), rate=rate, settings=settings))
    cut = cut_together(prepared, truth.names, rate=rate, settings=settings)
    impacts = Impacts(
        contacts=strikes.written_places,
        sounds=cut.sounds,
        sample_rate=rate,
        names=truth.names,
        directions=strikes.written_directions.float(),
        forces=forces,
        before=cut.before,
        after=cut.after,
    )
    return Capture(name, impacts, surface, settings)


def _kept(recipe: ObjectRecipe) -> int:
    """Return the samples of each sound that are asked for."""
    return round(recipe.seconds * recipe.sample_rate)


def _noise(
    recipe: ObjectRecipe, sounds: Float64[Tensor, "contacts frames"], forces: Float64[Tensor, " contacts"]
) -> Float64[Tensor, "contacts frames"]:
    """Return the room's noise per newton: one level in the room, and so more of it beneath fainter blows."""
    if recipe.noise_db is None:
        return torch.zeros_like(sounds)
    # The power over what is asked for, and not over the silence before the impact.
    power = float((sounds * forces[:, None]).square().mean()) * sounds.shape[1] / _kept(recipe)
    level = math.sqrt(power) * 10.0 ** (recipe.noise_db / 20.0)
    noise = room_noise(*sounds.shape, sample_rate=float(recipe.sample_rate), generator=stream(recipe.seed, "noise"))
    return level * torch.from_numpy(noise) / forces[:, None]
