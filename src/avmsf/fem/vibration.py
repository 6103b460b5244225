"""Damped vibrations of a body, and the sound pressure that they radiate, at a microphone or over all directions.

In the coordinates q of the undamped modes, whose shapes are mass-normalized, a force f at a place x obeys

    q'' + C q' + Omega^2 q = phi(x) f,   Omega the angular frequencies on a diagonal.

Damping in proportion to mass and stiffness has C = alpha + beta Omega^2, also diagonal: each mode then decays by itself
with d = (alpha + beta omega^2) / 2 at sqrt(omega^2 - d^2). Any other symmetric C mixes them. With y = (Omega q, q') the
system is y' = A y, A = ((0, Omega), (-Omega, -C)), and its eigenvalues s = -d + 2 pi i f and eigenvectors are the
damped modes, exact for every C: shapes become complex, so that places of one mode no longer move in step.

The pressure that a surface radiates is Kirchhoff's and Helmholtz's integral over the normal velocity v of its patches
and the pressure on them. Here the air is taken to push back on each patch as on a plane wave, with density times speed
of sound times v, which leaves a sum of simple sources,

    p = sum of rho s v area / (4 pi r) (1 + cos(theta) (1 + c / (s r))) exp(-2 pi i f r / c),

for a vibration exp(s t) at f Hz, with r from patch to microphone and theta between that line and the patch's normal:
monopoles with the dipoles that make a patch sound to its front and not to its back. There is no diffraction around the
body, no reflection from it or from a room. Monopoles alone would be simpler, but the two faces of a thin wall move
together, one outward and one inward, and would cancel. The time that the sound takes from the nearest patch is left
out: `travel_time` gives it, and it only moves the start of a recording. Delays of the others turn phases and no more:
what has decayed for longer was louder, but it starts later too, and a sum of modes has but one start.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf._utils.arrays import fibonacci_sphere
from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import Material

MAX_DAMPING_RATIO = 0.05
"""Damping over the critical one beyond which a mode is left out: it loses half its amplitude in two cycles, is no tone,
and continued back to the onset it would be the loudest of all where it is heard late."""


@dataclass(frozen=True, eq=False)
class Vibration:
    """What an impact leaves behind: damped modes by ascending frequency.

    After an impact that gives undamped mode k the momentum p_k, in sqrt(kg) m/s, mode k accelerates as the sum over
    damped modes r of 2 Re accelerations[k, r] (pushes[r] . p) exp(poles[r] t).
    """

    poles: Complex128[Tensor, " modes"]
    """-d + 2 pi i f, 1/s."""
    accelerations: Complex128[Tensor, "shapes modes"]
    """Of each undamped mode in each damped one."""
    pushes: Complex128[Tensor, "modes shapes"]
    """How much of a push on each undamped mode goes into each damped one."""

    @property
    def frequency(self) -> Float64[Tensor, " modes"]:
        """Damped frequencies, Hz."""
        return self.poles.imag / (2.0 * math.pi)

    @property
    def damping(self) -> Float64[Tensor, " modes"]:
        """Amplitude decay rates, 1/s."""
        return -self.poles.real


def rayleigh(frequency: Float64[Tensor, " modes"], material: Material) -> Float64[Tensor, " modes"]:
    """Return alpha + beta omega^2 for undamped frequencies in Hz: twice the amplitude decay rates, 1/s."""
    return material.alpha + material.beta * (2.0 * math.pi * frequency).square()


def damped(
    frequency: Float64[Tensor, " shapes"], damping: Float64[Tensor, "shapes shapes"], *, highest: float
) -> Vibration:
    """Return the damped modes that sound up to `highest` Hz.

    `frequency` holds undamped frequencies, Hz, and `damping` the matrix C, 1/s, symmetric. Modes damped by more than
    `MAX_DAMPING_RATIO` of their critical damping are left out. Raises SimulationError where none is left.
    """
    count = len(frequency)
    omega = 2.0 * math.pi * torch.diag(frequency)
    system = torch.cat([torch.cat([torch.zeros_like(omega), omega], 1), torch.cat([-omega, -damping], 1)])
    poles, vectors = torch.linalg.eig(system)
    # Rows of the inverse, not the vectors again, are what belongs to two modes that share a pole.
    inverse = torch.linalg.inv(vectors)
    ringing = (poles.imag > 0.0) & (-poles.real <= MAX_DAMPING_RATIO * poles.abs())
    audible = torch.nonzero(ringing & (poles.imag <= 2.0 * math.pi * highest)).flatten()
    if len(audible) == 0:
        lowest = float(frequency.min())
        wanted, got = f"damped modes up to {highest:g} Hz", f"none of {count}, the lowest at {lowest:.4g} Hz undamped"
        advice = "make the object larger or thinner, its material softer or less damped, or raise the sample rate"
        raise SimulationError.expected(wanted, lowest, got=got, name="frequency", advice=advice)
    audible = audible[torch.argsort(poles.imag[audible])]
    return Vibration(
        poles[audible], vectors[count:, audible] * poles[audible], inverse[audible, count:].resolve_conj().contiguous()
    )


AIR_DENSITY = 1.204
"""Kilograms per cubic meter, at 20 degrees Celsius."""
SOUND_SPEED = 343.2
"""Meters per second, at 20 degrees Celsius."""
MIN_DISTANCE_M = 0.01
"""Meters to the surface within which a patch is no small source."""


def radiated(
    modes: ElasticModes, vibration: Vibration, microphone: Float64[Tensor, " 3"], *, retardation: float = 1.0
) -> Complex128[Tensor, " modes"]:
    """Return the pressure at the microphone, pascals, of each damped mode for a push of one newton second on it alone.

    `microphone` is a place in the object frame, meters. `retardation` scales the differences of the patches' delays:
    0 hears the whole body at once. Raises SimulationError for a microphone closer than `MIN_DISTANCE_M` to the surface.
    """
    places, outward, motion = _patches(modes)
    towards = microphone - places
    distance = towards.norm(dim=1)
    nearest = float(distance.min())
    if nearest < MIN_DISTANCE_M:
        wanted = f"a distance of {MIN_DISTANCE_M:g} m or more from the object's surface"
        raise SimulationError.expected(wanted, nearest, got=f"{nearest:.2g} m", name="microphone")
    area = outward.norm(dim=1)
    facing = (outward * towards).sum(dim=1) / (area * distance).clamp(min=1e-300)
    delay = retardation * (distance - nearest) / SOUND_SPEED
    strength = AIR_DENSITY * area / (4.0 * math.pi * distance)
    pressures = []
    # A mode at a time: the table of all patches and modes would be larger than all else.
    for pole, accelerations in zip(vibration.poles, vibration.accelerations.T, strict=True):
        directed = 1.0 + facing * (1.0 + SOUND_SPEED / (pole * distance))
        kernel = strength * directed * torch.exp(-1j * pole.imag * delay)
        sources = torch.complex(kernel.real @ motion, kernel.imag @ motion)
        pressures.append(sources @ accelerations)
    return torch.stack(pressures)


def travel_time(modes: ElasticModes, microphone: Float64[Tensor, " 3"]) -> float:
    """Return the seconds that sound takes from the nearest patch to the microphone, a place in the object frame, m."""
    middles = modes.nodes[modes.triangles[:, 3:].reshape(-1)]
    return float((microphone - middles).norm(dim=1).min()) / SOUND_SPEED


def _patches(
    modes: ElasticModes,
) -> tuple[Float64[Tensor, "patches 3"], Float64[Tensor, "patches 3"], Float64[Tensor, "patches modes"]]:
    """Return places, outward normals times area, and normal displacement of each mode, three patches a triangle.

    The middles of a triangle's edges integrate quadratic functions exactly, and the shapes are quadratic.
    """
    corners = modes.nodes[modes.triangles[:, :3]]
    outward = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 6.0
    middles = modes.triangles[:, 3:].T.reshape(-1)
    outward = outward.repeat(3, 1)
    area = outward.norm(dim=1, keepdim=True).clamp(min=1e-300)
    shapes = modes.shapes[middles]
    motion = torch.einsum("pma,pa->pm", shapes, outward / area)
    return modes.nodes[middles], outward, motion


DIRECTIONS = 64
"""Directions that are averaged: levels of modes are .15 to .31 dB from those of 512 on average (mug, bowl, skillet)."""
_FAR_FIELD_RATIO = 100.0
"""Distance of the microphones over the body's size. Pressures go with 1/distance from there on."""


def radiated_pressure(modes: ElasticModes, vibration: Vibration) -> Float64[Tensor, " modes"]:
    """Return the pressure of each damped mode for a push of one newton second on it alone, pascals.

    The root mean square over directions of its amplitude in the far field, stated for a distance of one meter.
    """
    middle = 0.5 * (modes.nodes.amax(0) + modes.nodes.amin(0))
    reach = _FAR_FIELD_RATIO * float((modes.nodes.amax(0) - modes.nodes.amin(0)).norm())
    power = torch.zeros(len(vibration.poles), dtype=torch.float64)
    for way in fibonacci_sphere(DIRECTIONS):
        power += radiated(modes, vibration, middle + reach * way).abs().square()
    return reach * (power / DIRECTIONS).sqrt()
