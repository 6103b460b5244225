"""Symmetries of an object: rotations about an axis and mirror planes, each with how well it was found to hold."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import count_of, like, typed
from avmsf.errors import SceneError


@dataclass(frozen=True, eq=False)
class RotationalSymmetry:
    """Turning about an axis leaves the object as it is: by 1/order of a turn, or by any angle."""

    axis: Float[Tensor, " 3"]
    """Unit vector along the axis, of either sign."""
    point: Float[Tensor, " 3"]
    """Where the axis passes the object's middle, meters."""
    order: int | None
    """How many turns make a whole one, 2 or more; None where every angle is a symmetry. Then every plane that contains
    the axis mirrors the object too, and is not listed."""
    error: float
    """How far turned points lie from the surface, root mean square, in point spacings; see `find_symmetries`."""

    def turn(self, points: Float[Tensor, "points 3"], angle: float) -> Float[Tensor, "points 3"]:
        """Return the points turned about the axis by `angle`, radians."""
        axis, offset = self.axis.double(), points.double() - self.point.double()
        along = (offset @ axis)[:, None] * axis
        across = offset - along
        turned = math.cos(angle) * across + math.sin(angle) * torch.linalg.cross(axis.expand_as(across), across)
        return (self.point.double() + along + turned).to(points)

    def angles(self, count: int) -> list[float]:
        """Return the angles of an orbit, radians, 0 first: those of the order, or `count` even ones if continuous."""
        steps = count if self.order is None else self.order
        return [2 * math.pi * step / steps for step in range(steps)]

    def __str__(self) -> str:
        what = "any turn" if self.order is None else f"{self.order}-fold turn"
        return f"{what} about the axis ({_numbers(self.axis)}) through ({_numbers(self.point)}) m"


@dataclass(frozen=True, eq=False)
class MirrorSymmetry:
    """Reflection in a plane leaves the object as it is."""

    normal: Float[Tensor, " 3"]
    """Unit normal of the plane, of either sign."""
    point: Float[Tensor, " 3"]
    """The point of the plane nearest to the object's middle, meters."""
    error: float
    """As for a rotation."""

    def reflect(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Return the points' mirror images."""
        normal, places = self.normal.double(), points.double()
        return (places - 2 * ((places - self.point.double()) @ normal)[:, None] * normal).to(points)

    def __str__(self) -> str:
        return f"mirror plane with normal ({_numbers(self.normal)}) through ({_numbers(self.point)}) m"


@dataclass(frozen=True, eq=False)
class Symmetries:
    """The symmetries found on one cloud, best first, and the thresholds of the test."""

    rotations: tuple[RotationalSymmetry, ...]
    mirrors: tuple[MirrorSymmetry, ...]
    spacing: float
    """Distance between neighboring points of the cloud, meters: the unit of the errors."""
    tolerance: float
    """Errors up to this were accepted, in point spacings."""
    rejected: float
    """The least error of a rejected candidate, in point spacings; infinite if there was none."""

    def __bool__(self) -> bool:
        return bool(self.rotations or self.mirrors)

    def summary(self) -> str:
        """Return sentences on the symmetries found and their errors."""
        found: list[RotationalSymmetry | MirrorSymmetry] = [*self.rotations, *self.mirrors]
        measure = f"in point spacings of {1000 * self.spacing:.2g} mm; accepted up to {self.tolerance:.2f}"
        nearest = f"the best rejected candidate has an error of {self.rejected:.2f}"
        if not math.isfinite(self.rejected):
            nearest = "there was no other candidate"
        if self.tolerance <= 0.0:
            return "no symmetry found: the points are too few or too noisy to tell one, or fill a volume"
        if not found:
            return f"no symmetry found: {nearest} ({measure})"
        lines = [f"{each}: error {each.error:.2f}" for each in found]
        return "\n".join([*lines, f"errors are {measure}; {nearest}"])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, lists and strings, as JSON holds them; `from_dict` reads them back to the last bit."""
        return {
            "rotations": [_stored(each) for each in self.rotations],
            "mirrors": [_stored(each) for each in self.mirrors],
            "spacing": self.spacing,
            "tolerance": self.tolerance,
            # JSON knows no infinity.
            "rejected": self.rejected if math.isfinite(self.rejected) else None,
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> "Symmetries":
        """Read what `to_dict` returned, now or earlier. Raises SceneError for anything else."""
        try:
            rotations = tuple(RotationalSymmetry(**_read(each)) for each in stored["rotations"])
            mirrors = tuple(MirrorSymmetry(**_read(each)) for each in stored["mirrors"])
            rejected = math.inf if stored["rejected"] is None else _number(stored, "rejected")
            return cls(rotations, mirrors, _number(stored, "spacing"), _number(stored, "tolerance"), rejected)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            wanted, advice = "numbers as they are stored", "find the symmetries again"
            raise SceneError.expected(wanted, got=repr(error), name="symmetries", advice=advice) from error


def _numbers(values: Float[Tensor, " 3"]) -> str:
    # Adding zero turns -0 into 0.
    return " ".join(f"{round(value, 4) + 0.0:.4g}" for value in values.tolist())


def _stored(symmetry: RotationalSymmetry | MirrorSymmetry) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in vars(symmetry).items()}


def _read(stored: Mapping[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {name: _vector(stored, name) for name in stored.keys() - {"order", "error"}}
    if "order" in stored:
        values["order"] = None if stored["order"] is None else count_of(stored["order"], "order", least=2)
    return values | {"error": _number(stored, "error")}


def _vector(entry: Mapping[str, Any], name: str) -> Float[Tensor, " 3"]:
    value = typed(entry[name], tuple[float, float, float], name)
    length = math.hypot(*value)
    if not math.isfinite(length) or (name != "point" and abs(length - 1.0) > 1e-6):
        raise ValueError(f"{name}: expected {'finite numbers' if name == 'point' else 'a unit vector'}, got {value}")
    return torch.tensor(value, dtype=torch.float64)


def _number(entry: Mapping[str, Any], name: str) -> float:
    value = float(like(entry[name], 1.0, name))
    if not math.isfinite(value):
        raise ValueError(f"{name}: expected a finite number, got {value}")
    return value
