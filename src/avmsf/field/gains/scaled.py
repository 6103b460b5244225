"""Gains of what nobody recorded: of a body's mode shapes alone, and of an edited object."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf._utils.tensor_files import TensorReader
from avmsf._utils.text import RecordError, count_of, like
from avmsf.fem.elastic_modes import ElasticModes, mode_sizes, mode_tensors, restored_modes
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Directions, GainModel, Gains, Points

_BODY, _FITTED = "body.", "fitted."
"""What names of the tensors of a body and of a fitted model begin with."""


@dataclass(frozen=True, eq=False)
class BodyGains(GainModel):
    """Gains that are the components of mode shapes along the impacts."""

    __repr__ = short_repr

    points: Float32[Tensor, "points 3"]
    """Points of the object's surface, object frame, meters."""
    modes: ElasticModes
    """Each shape times the amplitude that a unit of it gives the sound."""

    kind: ClassVar[str] = "body"

    @property
    def body(self) -> ElasticModes:
        """The modes."""
        return self.modes

    def predict(self, points: Points, directions: Directions = None) -> Gains:
        """Return the gains; without a direction impacts go straight into the body."""
        sites = Sites.along(points.double(), directions, lambda unknown: -self.modes.normals(unknown))
        return Gains(self.modes.gains(sites.points, sites.directions).float())

    def record(self) -> dict[str, Any]:
        """Return the sizes."""
        sizes = mode_sizes(self.modes)
        return {"points": len(self.points), "modes": sizes.pop("shapes"), **sizes}

    def tensors(self) -> dict[str, Tensor]:
        """Return the points and the modes."""
        return {"points": self.points, **_named(_BODY, mode_tensors(self.modes))}

    @classmethod
    def restore(cls, record: Mapping[str, Any], read: TensorReader) -> "BodyGains":
        """Return the gains."""
        points = read("points", count_of(record["points"], "points"), 3, dtype=torch.float32)
        return cls(points, restored_modes({**record, "shapes": record["modes"]}, read.within(_BODY)))


FITTED: dict[str, type[GainModel]] = {each.kind: each for each in (AttentionGains, MixtureGains, BodyGains)}
"""The gain models beneath all edits, fitted to recordings or guessed, by what a file calls them."""


@dataclass(frozen=True, eq=False)
class ScaledGains(GainModel):
    """Gains that differ from fitted ones by a factor a mode, so that their ratio between places is the same.

    Of gains that are scaled already only the factors change: what is held are always fitted ones.
    """

    __repr__ = short_repr

    field: GainModel
    """The gains as they were fitted."""
    scale: Float64[Tensor, " modes"]
    """Factors on the gains of each mode; 0 mutes one."""
    length: float = 1.0
    """Lengths on this object over those on the fitted one: contacts are divided by it."""
    points: Float32[Tensor, "points 3"] = dataclasses.field(init=False)
    """Points of the object's surface, object frame, meters."""

    kind: ClassVar[str] = "scaled"

    def __post_init__(self) -> None:
        if not 0.0 < self.length < math.inf:
            raise ValueError(f"length is {self.length}")
        inner = self.field
        if isinstance(inner, ScaledGains):
            object.__setattr__(self, "field", inner.field)
            object.__setattr__(self, "scale", inner.scale * self.scale)
            object.__setattr__(self, "length", inner.length * self.length)
        object.__setattr__(self, "points", (self.field.points.double() * self.length).float())

    @property
    def fitted(self) -> GainModel:
        """The gains as they were fitted."""
        return self.field

    @property
    def body(self) -> ElasticModes | None:
        """The fitted gains' body."""
        return self.field.body

    @property
    def contacts(self) -> Float64[Tensor, "contacts 3"]:
        """The fitted gains' contacts, where they are on this object."""
        return self.field.contacts * self.length

    def predict(self, points: Points, directions: Directions = None) -> Gains:
        """Return the scaled gains; the factors on the dampings are the fitted ones."""
        return self._scaled(self.field.predict(points.double() / self.length, directions))

    def point_estimate(self, points: Points, directions: Directions = None) -> Gains:
        """Return the fitted gains' estimate, scaled likewise."""
        return self._scaled(self.field.point_estimate(points.double() / self.length, directions))

    def posterior(self, points: Points, directions: Directions = None) -> Gains:
        """Return the fitted gains' posterior, scaled likewise."""
        return self._scaled(self.field.posterior(points.double() / self.length, directions))

    def record(self) -> dict[str, Any]:
        """Return the fitted gains' record, what a file calls these, and the length."""
        return {**self.field.record(), "fitted_kind": self.field.kind, "size_factor": self.length}

    def tensors(self) -> dict[str, Tensor]:
        """Return the factors and the fitted gains' tensors."""
        return {"mode_factors": self.scale, **_named(_FITTED, self.field.tensors())}

    @classmethod
    def restore(cls, record: Mapping[str, Any], read: TensorReader) -> "ScaledGains":
        """Return the gains."""
        length = float(like(record["size_factor"], 1.0, "size_factor"))
        if not 0.0 < length < math.inf:
            raise RecordError.expected("a number above 0", length, name="size_factor")
        kind = like(record["fitted_kind"], "", "fitted_kind")
        if kind not in FITTED:
            raise RecordError.expected(", ".join(FITTED), kind, name="fitted_kind")
        scale = read("mode_factors", count_of(record["modes"], "modes"))
        return cls(FITTED[kind].restore(record, read.within(_FITTED)), scale, length)

    def _scaled(self, known: Gains) -> Gains:
        mean = (known.mean * self.scale).to(known.mean.dtype)
        std = None if known.std is None else (known.std.double() * self.scale.abs()[:, None]).float()
        return replace(known, mean=mean, std=std)


def _named(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {prefix + name: each for name, each in tensors.items()}
