"""Which of an object's symmetries carries one place to another: why two places sound the same."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float, Float32
from torch import Tensor

from avmsf.scene.symmetry import MirrorSymmetry, RotationalSymmetry, Symmetries

_ANGLES = 360
"""Steps in which a place is turned about an axis that allows any angle."""


@dataclass(frozen=True, eq=False)
class Counterpart:
    """A place that may have been struck as well as the likeliest one."""

    position: Float32[Tensor, " 3"]
    """Object frame, meters."""
    probability: float
    """That the blow fell there."""
    symmetry: RotationalSymmetry | MirrorSymmetry | None
    """What carries the likeliest place to this one; None where nothing known does."""
    angle: float | None
    """By which it is turned, radians, for a rotation."""

    def __str__(self) -> str:
        where = " ".join(f"{round(value, 4) + 0.0:.4g}" for value in self.position.tolist())
        if self.symmetry is None:
            why = "no known symmetry of the object explains it"
        elif isinstance(self.symmetry, MirrorSymmetry):
            why = f"its image in the {self.symmetry}"
        else:
            assert self.angle is not None
            axis = str(self.symmetry).split(" about ")[1]
            why = f"its rotation by {math.degrees(self.angle):.0f} degrees about {axis}"
        return f"also at ({where}) m, with {100 * self.probability:.0f} %: {why}"


def name_counterpart(
    place: Float[Tensor, " 3"],
    other: Float[Tensor, " 3"],
    symmetries: Symmetries | None,
    *,
    probability: float,
    tolerance: float,
) -> Counterpart:
    """Return `other` as a counterpart of `place` (meters), with the symmetry that carries one to the other best.

    Images farther than `tolerance` meters from `other` do not count, nor do symmetries that leave `place` about where
    it is.
    """
    nearest, found, turned = tolerance, None, None
    for symmetry, angle, image in _images(place, symmetries):
        distance = float((image - other.double()).norm())
        if distance < nearest and float((image - place.double()).norm()) > distance:
            nearest, found, turned = distance, symmetry, angle
    return Counterpart(other, probability, found, turned)


def _images(
    place: Float[Tensor, " 3"], symmetries: Symmetries | None
) -> Iterator[tuple[RotationalSymmetry | MirrorSymmetry, float | None, Float[Tensor, " 3"]]]:
    if symmetries is None:
        return
    row = place.double()[None]
    for mirror in symmetries.mirrors:
        yield mirror, None, mirror.reflect(row)[0]
    for rotation in symmetries.rotations:
        for angle in rotation.angles(_ANGLES)[1:]:
            yield rotation, angle, rotation.turn(row, angle)[0]
