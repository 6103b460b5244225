"""A recipe in, an object out that was struck and recorded: a capture, its truth, and what it looks like."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Complex128, Float32, Float64
from scipy.fft import irfft, next_fast_len
from torch import Tensor

from avmsf.capture.audio import Recording
from avmsf.capture.folder import Capture
from avmsf.capture.preprocess import preprocess
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Impact
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.vibration import Vibration, damped, radiated, travel_time
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.modal.modes import synthesize
from avmsf.simulate.bodies import Body, make_body, up_of
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.hammer import contact_times, peak_forces, pulse_spectrum
from avmsf.simulate.imperfections import damping_matrix, frequency_factors, recording_starts
from avmsf.simulate.recipe import Hammer, ObjectRecipe
from avmsf.simulate.shapes.body import stream
from avmsf.simulate.strikes import Strikes, draw_strikes


def recorded(
    poles: Complex128[Tensor, "*#contacts modes"],
    amplitudes: Complex128[Tensor, "contacts modes"],
    starts: Float64[Tensor, " contacts"],
    *,
    sample_rate: float,
    samples: int,
) -> Float64[Tensor, "contacts samples"]:
    """Return the real part of the sum of amplitude times exp(pole t), t = 0 at the samples `starts`, and zero before.

    Starts may lie between samples: amplitudes are those at the start, and each sample has the sound's exact value at
    its time after it. Nothing is interpolated. Of a sound that starts before the recording (negative), the rest is
    heard.
    """
    first = starts.ceil().clamp(min=0.0)
    late = (first - starts) / sample_rate
    moved = 1j * amplitudes * torch.exp(poles * late[:, None])
    frequency, damping = poles.imag / (2 * math.pi), -poles.real
    sounds = synthesize(moved, frequency, damping, samples=samples, sample_rate=sample_rate)
    whole = torch.zeros_like(sounds)
    for row, begin in enumerate(first.long().tolist()):
        whole[row, begin:] = sounds[row, : samples - begin]
    return whole


PINK, RUMBLE, WHITE = 0.5, 0.4, 0.1
"""Parts of the noise's power: of the room, of the building, of the recorder."""
MIN_NOISE_HZ = 20.0
"""Hz below which the spectrum does not grow any more."""


def room_noise(
    count: int, samples: int, *, sample_rate: float, generator: np.random.Generator
) -> Float64[np.ndarray, "contacts samples"]:
    """Return Gaussian noise with a root mean square of 1 on average, each row by itself.

    Half of its power is pink, 1/f; four tenths are the rumble of a building, 1/f^3; a tenth is white.
    """
    size = next_fast_len(samples, real=True)
    frequency = np.fft.rfftfreq(size, 1.0 / sample_rate)
    bounded = np.maximum(frequency, MIN_NOISE_HZ)
    power = np.zeros(len(frequency))
    for part, exponent in ((PINK, -1.0), (RUMBLE, -3.0), (WHITE, 0.0)):
        each = np.where(frequency > 0.0, bounded**exponent, 0.0)
        power += part * each / each.sum()
    # A bin of unit variance in its real and its imaginary part has 4 / size^2 of power, for it counts twice.
    level = size * np.sqrt(power / 4.0)
    # A row at a time: what is drawn for one does not depend on how many follow.
    rows = []
    for _ in range(count):
        spectrum = generator.standard_normal(len(level)) + 1j * generator.standard_normal(len(level))
        rows.append(irfft(level * spectrum, size)[:samples])
    return np.stack(rows)


@dataclass(frozen=True, eq=False)
class SoundingBody:
    """Elastic modes, how they decay, and the pressure of each at the microphone."""

    elastic: ElasticModes
    vibration: Vibration
    pressures: Complex128[Tensor, " modes"]
    """Pressure of each damped mode for a push of one newton second on it alone, pascals."""
    hammer: Hammer
    delay: float = 0.0
    """Time that sound takes from the nearest point of the surface to the microphone, seconds."""

    def gains(
        self,
        places: Float64[Tensor, "contacts 3"],
        directions: Float64[Tensor, "contacts 3"],
        *,
        speeds: Float64[Tensor, " contacts"] | None = None,
        contact_times: Float64[Tensor, " contacts"] | None = None,
    ) -> Complex128[Tensor, "contacts modes"]:
        """Return amplitudes A, pascals per newton of peak force: an impact sounds as the real part of A exp(pole t).

        `places` are taken to the nearest points of the surface; `directions` are unit vectors; `speeds` are relative
        to the hammer's and `contact_times` to those of these speeds, 1 without them. Time counts from when the sound of
        the hammer's first touch arrives at the microphone, and the sound is the one that goes on once the hammer has
        left, continued back to that moment.
        """
        times = self.times(torch.ones(len(places), dtype=torch.float64) if speeds is None else speeds, contact_times)
        pushed = self.elastic.gains(places, directions).to(torch.complex128) @ self.vibration.pushes.T
        return 2.0 * pushed * self.pressures * pulse_spectrum(self.hammer, self.vibration.poles, times)

    def times(
        self, speeds: Float64[Tensor, " contacts"], factors: Float64[Tensor, " contacts"] | None = None
    ) -> Float64[Tensor, " contacts"]:
        """Return how long the hammer stays on the body, seconds, at relative speeds, times the factors."""
        speeds = self.hammer.speed * speeds
        times = contact_times(self.hammer, self.elastic.material, mass=self.elastic.mass, speeds=speeds)
        return times if factors is None else factors * times

    def forces(
        self, speeds: Float64[Tensor, " contacts"], contact_times: Float64[Tensor, " contacts"] | None = None
    ) -> Float64[Tensor, " contacts"]:
        """Return the peak force of impacts of these relative speeds and contact times, newtons."""
        times = self.times(speeds, contact_times)
        return peak_forces(self.hammer, mass=self.elastic.mass, speeds=self.hammer.speed * speeds, times=times)


MAX_FREQUENCY_RATIO = 0.45
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
    """Gives the gains of any other impact."""


def simulate_object(
    recipe: ObjectRecipe,
    *,
    name: str | None = None,
    cache: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Simulate an object, its impacts and its recordings.

    `name` is what the object is called: shape or mesh and material without it. Elastic modes are kept in the folder
    `cache`, where one is given, and found there again by all that decides them. `progress` gets what comes next.
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
    name = name or f"{recipe.kind if recipe.mesh is None else recipe.mesh.stem}-{recipe.material.lower()}"
    capture = _captured(recipe, recordings, strikes, forces, truth, name=name, surface=seen)
    return Simulation(recipe, capture, recordings, truth, body.mesh, sounding)


def sounding_body(recipe: ObjectRecipe, body: Body) -> SoundingBody:
    """Return how a body sounds at the recipe's microphone when it is struck with the recipe's hammer."""
    matrix = damping_matrix(
        body.elastic, recipe.imperfections, supports=body.supports, generator=stream(recipe.seed, "coupling")
    )
    vibration = damped(body.elastic.frequency, matrix, highest=MAX_FREQUENCY_RATIO * recipe.sample_rate)
    vertices = body.surface.vertices.double()
    microphone = 0.5 * (vertices.amax(0) + vertices.amin(0)) + torch.tensor(recipe.microphone, dtype=torch.float64)
    pressures = radiated(body.elastic, vibration, microphone, retardation=recipe.imperfections.retardation)
    return SoundingBody(body.elastic, vibration, pressures, recipe.hammer, travel_time(body.elastic, microphone))


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
    poles, shifts = body.vibration.poles, None
    if imperfections.sensor or imperfections.warming:
        factors = frequency_factors(body.elastic, body.vibration, strikes.places, imperfections)
        poles, shifts = torch.complex(poles.real.expand_as(factors), factors * poles.imag), factors - 1.0
    sounds = recorded(poles, amplitudes, starts, sample_rate=rate, samples=frames)
    sounds = sounds + _noise(recipe, sounds, written)
    truth = Truth(
        frequency=body.vibration.frequency,
        damping=body.vibration.damping,
        gains=1j * amplitudes,
        names=tuple(f"{row + 1:03d}.wav" for row in range(len(sounds))),
        recipe=recipe.values(),
        contacts=strikes.places,
        starts=starts,
        shifts=shifts,
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
        name=name, seconds=_kept(recipe) / recipe.sample_rate, normalize="done", align=bool((truth.starts != 0.0).any())
    )
    written = strikes.written_places.tolist(), strikes.written_directions.tolist(), forces.tolist()
    sounds = (
        Recording(name, sound.double().numpy()[None], rate, "FLOAT")
        for name, sound in zip(truth.names, recordings, strict=True)
    )
    pairs = zip(map(Impact, truth.names, *written), sounds, strict=True)
    impacts, _ = preprocess(pairs, settings, measured=False)
    assert impacts is not None
    return Capture(name, impacts, surface, settings)


def _kept(recipe: ObjectRecipe) -> int:
    """Return the samples of each sound that are asked for."""
    return round(recipe.seconds * recipe.sample_rate)


def _noise(
    recipe: ObjectRecipe, sounds: Float64[Tensor, "contacts frames"], forces: Float64[Tensor, " contacts"]
) -> Float64[Tensor, "contacts frames"]:
    """Return the room's noise per newton: one level in the room, and so more of it beneath fainter impacts."""
    if recipe.noise_db is None:
        return torch.zeros_like(sounds)
    # The power over what is asked for, and not over the silence before the impact.
    power = float((sounds * forces[:, None]).square().mean()) * sounds.shape[1] / _kept(recipe)
    level = math.sqrt(power) * 10.0 ** (recipe.noise_db / 20.0)
    noise = room_noise(*sounds.shape, sample_rate=float(recipe.sample_rate), generator=stream(recipe.seed, "noise"))
    return level * torch.from_numpy(noise) / forces[:, None]
