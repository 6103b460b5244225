"""The sides from which pictures show an object, and the names of its axes in them."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from avmsf.errors import EvaluationError
from avmsf.plotting.style import FIRST

Side: TypeAlias = tuple[float, float]
"""Azimuth about the direction to the sky, and elevation above the horizon, of an eye far away; degrees."""
UP = (0.0, 0.0, 1.0)
ABOVE = 25.0
"""Elevation of an eye that looks into what is open above and still sees the sides, degrees."""
AROUND: tuple[Side, ...] = tuple((azimuth, ABOVE) for azimuth in (30.0, 120.0, 210.0, 300.0))
"""Four sides from a little above."""
ALL_SIDES: tuple[Side, ...] = (
    (-60.0, 25.0),
    (60.0, 25.0),
    (180.0, 25.0),
    (-60.0, 75.0),
    (-60.0, -25.0),
    (-60.0, -75.0),
)
"""Three sides, into what is open above, and two from below: nothing on a convex object is out of sight in all."""
_ARROW = 28.0
"""Length of the arrows along the axes, points."""


def side_words(side: Side) -> str:
    """Return a side's azimuth and elevation as text."""
    azimuth, elevation = side
    return f"azimuth {azimuth:g}°, elevation {elevation:g}°"


def view_from(side: Side, up: Sequence[float] = UP) -> Float[np.ndarray, "3 3"]:
    """Return rows right, up and towards the eye of a side; azimuth 0 looks from the axis after the one that is up.

    That is from x where z is up, from z where y is. Raises EvaluationError where `up` is no direction.
    """
    azimuth, elevation = side
    sky = np.asarray(up, dtype=float)
    if sky.shape != (3,) or not np.isfinite(sky).all() or np.linalg.norm(sky) == 0.0:
        raise EvaluationError(f"expected an up direction of three numbers, got {list(up)}", name="up", value=list(up))
    sky = sky / np.linalg.norm(sky)
    first = np.roll(np.eye(3)[np.argmax(np.abs(sky))], 1)
    first = first - (first @ sky) * sky
    first /= np.linalg.norm(first)
    angle, height = math.radians(azimuth), math.radians(elevation)
    level = math.cos(angle) * first + math.sin(angle) * np.cross(sky, first)
    eye = math.cos(height) * level + math.sin(height) * sky
    right = np.cross(sky, level)
    return np.stack([right, np.cross(eye, right), eye])


def name_axes(axes: Axes, view: Float[np.ndarray, "3 3"]) -> None:
    """Draw the directions of x, y and z in the lower left corner; rows of `view` as of `view_from`."""
    for axis, name in enumerate("xyz"):
        across, along = _ARROW * view[:2, axis]
        # What points at the eye or away from it has no direction here.
        if np.hypot(across, along) > 0.4 * _ARROW:
            axes.annotate(
                name,
                (0.06, 0.06),
                (across, along),
                xycoords="axes fraction",
                textcoords="offset points",
                arrowprops={"arrowstyle": "<-", "color": FIRST},
                color=FIRST,
                ha="center",
                va="center",
            )
