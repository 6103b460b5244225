"""Glaze and decor: colors of a surface by chance, some of which follow its form and some do not."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

_GLAZES = np.array([
    (0.93, 0.91, 0.85), (0.55, 0.68, 0.74), (0.72, 0.79, 0.68), (0.84, 0.62, 0.44),
    (0.45, 0.52, 0.60), (0.88, 0.78, 0.52), (0.62, 0.42, 0.36), (0.80, 0.76, 0.82),
])  # fmt: skip
_PAINTS = np.array([
    (0.13, 0.22, 0.48), (0.55, 0.13, 0.12), (0.10, 0.33, 0.28), (0.20, 0.14, 0.12),
    (0.86, 0.52, 0.10), (0.97, 0.95, 0.90), (0.38, 0.20, 0.45),
])  # fmt: skip
_EDGE = 0.006
"""Width of the edge of what is painted, in object diagonals."""
_LEAST_CONTRAST = 0.45

Decor = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""From places in object diagonals, about the middle, to how far inside of the paint each lies, in diagonals."""


def glaze(points: Float64[np.ndarray, "points 3"], random: np.random.Generator) -> Float64[np.ndarray, "points 3"]:
    """Return red, green and blue of each point, 0 to 1: a glaze, uneven as fired ones are, with paint on it."""
    low, high = points.min(axis=0), points.max(axis=0)
    places = (points - 0.5 * (low + high)) / np.linalg.norm(high - low)
    ground = _GLAZES[random.integers(len(_GLAZES))]
    contrast = np.linalg.norm(_PAINTS - ground, axis=1)
    fitting = _PAINTS[contrast > _LEAST_CONTRAST]
    paint = fitting[random.integers(len(fitting))]
    decor = DECORS[int(random.integers(len(DECORS)))]
    inside = np.clip(0.5 + decor(places, random) / _EDGE, 0.0, 1.0)[:, None]
    colors = ground + inside * (paint - ground)
    cloudy = 0.03 + 0.07 * random.random()
    light = 1.0 + cloudy * _waves(places, random, 0.35, 12) + 0.02 * random.standard_normal(len(points))
    return np.clip(colors * light[:, None], 0.0, 1.0)


def _bands(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Two to four level bands."""
    low, high = places[:, 2].min(), places[:, 2].max()
    number = int(random.integers(2, 5))
    levels = low + (high - low) * np.sort(random.uniform(0.1, 0.98, number))
    width = random.uniform(0.012, 0.03)
    return (width - np.abs(places[:, 2, None] - levels)).max(axis=1)


def _dipped(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """All beyond a slanting plane."""
    slanting = np.array([random.normal(), random.normal(), 1.0])
    heights = places @ (slanting / np.linalg.norm(slanting))
    return heights - np.quantile(heights, random.uniform(0.45, 0.75))


def _spots(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Round spots anywhere."""
    centers = places[random.integers(len(places), size=int(random.integers(14, 30)))]
    radii = random.uniform(0.025, 0.06, len(centers))
    return (radii - np.linalg.norm(places[:, None] - centers, axis=-1)).max(axis=1)


def _strokes(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Curved lines as of a brush."""
    height = _waves(places, random, random.uniform(0.35, 0.6), 6)
    # The field's slope is about 2 pi over its wavelength: so wide a stroke is a few hundredths of the diagonal.
    return 0.08 * (0.28 - np.abs(height))


def _patches(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Large patches with wavy outlines."""
    height = _waves(places, random, 0.5, 8)
    return 0.08 * (height - np.quantile(height, random.uniform(0.55, 0.75)))


DECORS: tuple[Decor, ...] = (_bands, _dipped, _spots, _strokes, _patches)


def _waves(places: np.ndarray, random: np.random.Generator, length: float, number: int) -> np.ndarray:
    """Return a smooth field of root mean square 1 in space, of waves about this long."""
    ways = random.standard_normal((number, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True) * length * random.uniform(0.7, 1.5, (number, 1))
    phases = random.uniform(0.0, 2.0 * math.pi, number)
    return math.sqrt(2.0 / number) * np.cos(2.0 * math.pi * places @ ways.T + phases).sum(axis=1)
