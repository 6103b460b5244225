"""What makes a simulated object as untidy as a real one, each thing by itself and by seed.

All random numbers of one thing come from a stream of its own, so that switching one off changes none of the others.
"""

import math
import zlib

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.fem.damping import Vibration, rayleigh
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.simulate.recipe import Imperfections

_LEGS = 3
_PATCHES = 16
"""Places where damping sits that couples modes."""
_WAVES = 24
"""Plane waves of which a smooth random field is made."""
_MIN_WAVELENGTH = 0.4
"""Shortest wavelength of such a field, in object diagonals; the longest is five times that."""


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


def frequency_factors(
    modes: ElasticModes, vibration: Vibration, places: Float64[Tensor, "contacts 3"], imperfections: Imperfections
) -> Float64[Tensor, "contacts modes"]:
    """Return what multiplies the frequency of each damped mode in the recording of each contact.

    A point mass m lowers the frequency of a mode of mass-normalized shape phi by m |phi|^2 / 2, to first order.
    """
    shapes = torch.stack([modes.gains(places, axis.expand_as(places)) for axis in torch.eye(3, dtype=torch.float64)])
    parts = vibration.pushes.abs().square()
    loads = shapes.square().sum(0) @ (parts / parts.sum(1, keepdim=True)).T
    times = torch.linspace(0.0, 1.0, len(places), dtype=torch.float64)[:, None]
    return (1.0 - 0.5 * imperfections.sensor * modes.mass * loads) * (1.0 - imperfections.warming * times)


def smooth_field(
    places: Float64[Tensor, "points 3"], spread: float, *, diagonal: float, generator: np.random.Generator
) -> Float64[Tensor, " points"]:
    """Return factors that vary smoothly over a body of this diagonal, meters, with a mean near 1.

    Their logarithm is a sum of plane waves with random directions, phases and wavelengths, of this root mean square.
    """
    if spread == 0.0:
        return torch.ones(len(places), dtype=torch.float64)
    directions = generator.standard_normal((_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = _MIN_WAVELENGTH * diagonal * np.exp(generator.uniform(0.0, math.log(5.0), _WAVES))
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
