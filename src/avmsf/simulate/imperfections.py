"""What makes a simulated object as untidy as a real one, each thing by itself and by seed.

All random numbers of one thing come from a stream of its own, so that switching one off changes none of the others.
"""

import math
import zlib
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.simulate.elastic import ElasticModes
from avmsf.simulate.vibration import rayleigh

_LEGS = 3
_PATCHES = 16
"""Places where damping sits that couples modes."""
_WAVES = 24
"""Plane waves of which a smooth random field is made."""
_GRAIN = 0.4
"""Shortest wavelength of such a field, in object diagonals; the longest is five times that."""


@dataclass(frozen=True)
class Imperfections:
    """How far an object and its recordings stray from a textbook; 0 switches each off."""

    thickness: float = 0.03
    """Variation of the walls' thickness, root mean square over its mean."""
    stiffness: float = 0.05
    """Variation of Young's modulus over the body, root mean square of its logarithm."""
    density: float = 0.02
    """Variation of the density, likewise."""
    support: float = 15.0
    """Frequency at which the object would bounce on three soft springs under it, Hz."""
    support_damping: float = 0.015
    """Damping of that bouncing, over the critical one."""
    coupling: float = 0.2
    """Part of all damping that sits at places of its own and so couples modes, 0 to 1."""
    retardation: float = 1.0
    """Part of the differences of delay between the body and the microphone that is heard, 0 to 1."""
    contact: float = 0.0015
    """Distance between where a blow was written down and where it fell, along the surface, metres, root mean square."""
    direction: float = 5.0
    """Angle between the blow's direction as written and as it was, degrees, root mean square."""
    force: float = 0.02
    """Error of the written peak force, relative, root mean square."""
    speed: float = 0.3
    """Variation of the impacts' speeds, root mean square of their logarithm.

    The peak forces of 74 impacts by hand (the aircraft test of the benchmarks) vary by .37, 3.2 dB, with a range of 16
    dB. By Hertz's law force goes with speed to the power 6/5, so speeds vary by .31.
    """
    contact_time: float = 0.1
    """Variation of the contact times that does not follow from the speeds, root mean square of their logarithm.

    The hand adds mass to the hammer, and the tip does not meet the surface square. In 31 impacts by hand on ceramic,
    wood, polycarbonate and steel (the recordings published with DiffImpact, Clarke et al. 2021) the pulses' widths
    depart from Hertz's law by .11.
    """
    pretrigger: float = 0.05
    """Time that a recording runs before the impact's sound arrives, seconds; the next two add to it."""
    jitter: float = 0.001
    """Variation of that time from recording to recording, seconds, root mean square.

    A recorder's clock is not locked to the impact: at 48 kHz the default is 48 samples, so the fraction of a sample at
    which a sound starts is uniformly random.
    """
    propagation: float = 1.0
    """Part of the time that sound takes from the object's nearest point to the microphone that delays the recordings,
    0 to 1."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            highest = {
                "coupling": 1.0, "retardation": 1.0, "contact": 1.0, "direction": 45.0, "support": math.inf,
                "pretrigger": 10.0, "propagation": 1.0,
            }  # fmt: skip
            most = highest.get(each.name, 0.5)
            if not (0 <= value <= most and math.isfinite(value)):
                raise SimulationError(
                    f"imperfections: {each.name} = {value:g}: expected 0 to switch it off"
                    f"{f', or up to {most:g}' if math.isfinite(most) else ' or a finite number above it'}"
                )

    @classmethod
    def none(cls) -> "Imperfections":
        """Return the record with everything switched off, sounds heard from all parts of the body at their times.

        Every recording then starts with the sound of its impact.
        """
        return replace(cls(**{each.name: 0.0 for each in fields(cls)}), retardation=1.0)


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one thing."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def recording_starts(
    count: int, imperfections: Imperfections, *, delay: float, sample_rate: float, seed: int
) -> Float64[Tensor, " contacts"]:
    """Return the sample of each recording, counted from 0 and between samples too, at which the impact's sound starts.

    `delay` is the time that sound takes to the microphone, seconds. Negative where the recording starts too late.
    """
    drawn = torch.from_numpy(stream(seed, "recording starts").standard_normal(count))
    before = imperfections.pretrigger + imperfections.propagation * delay
    return sample_rate * (before + imperfections.jitter * drawn)


def smooth_field(
    places: Float64[Tensor, "points 3"], spread: float, *, diagonal: float, generator: np.random.Generator
) -> Float64[Tensor, " points"]:
    """Return factors that vary smoothly over a body of this diagonal, metres, with a mean near 1.

    Their logarithm is a sum of plane waves with random directions, phases and wavelengths, of this root mean square.
    """
    if spread == 0.0:
        return torch.ones(len(places), dtype=torch.float64)
    directions = generator.standard_normal((_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = _GRAIN * diagonal * np.exp(generator.uniform(0.0, math.log(5.0), _WAVES))
    phases = generator.uniform(0.0, 2.0 * math.pi, _WAVES)
    heights = np.cos(2.0 * math.pi * places.numpy() @ (directions / lengths[:, None]).T + phases).sum(axis=1)
    return torch.from_numpy(np.exp(spread * math.sqrt(2.0 / _WAVES) * heights))


def support_places(
    surface: Float64[Tensor, "points 3"], up: Float64[Tensor, " 3"], *, generator: np.random.Generator
) -> Float64[Tensor, "legs 3"]:
    """Return three of the surface's points that it could stand on, as far apart as the low ones allow."""
    height = surface @ up
    low = surface[height <= height.min() + 0.05 * (height.max() - height.min()).clamp(min=1e-9)]
    middle = low.mean(dim=0)
    start = generator.uniform(0.0, 2.0 * math.pi)
    across = torch.linalg.svd(up[None])[2][1:]
    turns = start + 2.0 * math.pi / _LEGS * torch.arange(_LEGS, dtype=torch.float64)
    ways = torch.cos(turns)[:, None] * across[0] + torch.sin(turns)[:, None] * across[1]
    return low[((low - middle) @ ways.T).argmax(dim=0)]


def support_springs(mass: float, imperfections: Imperfections) -> float:
    """Return the stiffness of each spring under a body of this mass, newtons per metre."""
    return mass * (2.0 * math.pi * imperfections.support) ** 2 / _LEGS


def damping_matrix(
    modes: ElasticModes,
    imperfections: Imperfections,
    *,
    supports: Float64[Tensor, "legs 3"],
    generator: np.random.Generator,
) -> Float64[Tensor, "modes modes"]:
    """Return how velocities of undamped modes brake each other, 1/s: symmetric and positive definite.

    With D the dampings of Rayleigh's law on a diagonal, S the shapes at the supports and W the products of the shapes
    at random patches, rows scaled to length 1,

        C = D^(1/2) ((1 - coupling) + coupling W W^T) D^(1/2) + c S S^T.

    The first part keeps each mode's own damping and makes it uneven over the body.
    """
    own = rayleigh(modes.frequency, modes.material)
    matrix = torch.diag(own)
    if imperfections.coupling > 0.0:
        rows = generator.integers(len(modes.nodes), size=_PATCHES)
        shapes = modes.shapes[torch.from_numpy(rows)].transpose(0, 1).reshape(len(modes), -1)
        shapes = shapes / shapes.norm(dim=1, keepdim=True).clamp(min=1e-300)
        root = torch.sqrt(own)
        mixed = root[:, None] * (shapes @ shapes.T) * root
        matrix = matrix + imperfections.coupling * (mixed - matrix)
    if imperfections.support > 0.0 and imperfections.support_damping > 0.0:
        rate = 2.0 * math.pi * imperfections.support
        damper = 2.0 * imperfections.support_damping * modes.mass * rate / _LEGS
        held = modes.at(supports).transpose(0, 1).reshape(len(modes), -1)
        matrix = matrix + damper * held @ held.T
    return matrix
