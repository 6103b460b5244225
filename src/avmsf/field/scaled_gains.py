"""Gains of what nobody recorded: of a body's mode shapes alone, and of an edited object."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf._utils.text import RecordError, count_of, like
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.elastic_store import mode_sizes, mode_skeleton, mode_tensors, restored_modes
from avmsf.field.attention import AttentionGains
from avmsf.field.gain_field import GainField, Gains
from avmsf.field.gains.family import sites_along
from avmsf.field.gains.model import MixtureGains
from avmsf.mesh.surface import Surface


@dataclass(frozen=True, eq=False)
class BodyGains(GainField):
    """Gains that are the components of mode shapes along the impacts."""

    __repr__ = short_repr

    points: Float32[Tensor, "points 3"]
    """Points of the object's surface, object frame, meters."""
    body: ElasticModes
    """The modes, each shape times the amplitude that a unit of it gives the sound."""

    kind: ClassVar[str] = "body"

    def normals(self, points: Float[Tensor, "points 3"]) -> Float64[Tensor, "points 3"]:
        """Return the outward unit normals of the body's surface nearest to points."""
        return self.body.normals(points.double())

    def at(self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None) -> Gains:
        """Return the gains at contacts (meters); without a direction impacts go straight into the body."""
        sites = sites_along(contacts.double(), directions, lambda points: -self.normals(points))
        return Gains(self.body.gains(sites.points, sites.directions).float())

    def record(self) -> dict[str, Any]:
        """Return the sizes."""
        sizes = mode_sizes(self.body)
        return {"points": len(self.points), "modes": sizes.pop("shapes"), **sizes}

    def tensors(self) -> dict[str, Tensor]:
        """Return the points and the modes."""
        return {"points": self.points, **{f"body.{name}": each for name, each in mode_tensors(self.body).items()}}

    @classmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors like those of a body of these sizes."""
        named = mode_skeleton({**record, "shapes": record["modes"]})
        points = torch.empty(count_of(record["points"], "points"), 3, device="meta")
        return {"points": points, **{f"body.{name}": each for name, each in named.items()}}

    @classmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "BodyGains":
        """Return the gains."""
        return cls(tensors["points"], restored_modes(tensors, "body."))


FITTED: dict[str, type[GainField]] = {each.kind: each for each in (AttentionGains, MixtureGains, BodyGains)}
"""The gain fields beneath all edits, fitted to recordings or guessed, by what a file calls them."""
_INNER = "fitted."


@dataclass(frozen=True, eq=False)
class ScaledGains(GainField):
    """Gains that differ from a fitted field's by a factor a mode, so that their ratio between places is the same.

    Of a field that is scaled already only the factors change: what is held is always a fitted field.
    """

    __repr__ = short_repr

    field: GainField
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
    def contacts(self) -> Float[Tensor, "contacts 3"]:
        """Contacts that the gains were fitted to, where they are on this object; none where these are not known."""
        fitted = getattr(self.field, "contacts", self.field.points[:0])
        return fitted.double() * self.length

    def at(self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None) -> Gains:
        """Return the scaled gains; the factors on the dampings are the fitted ones."""
        return self._edited(self.field.at(contacts.double() / self.length, directions))

    def point_estimate(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Gains:
        """Return the fitted field's estimate, scaled likewise."""
        return self._edited(self.field.point_estimate(contacts.double() / self.length, directions))

    def deviation(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts modes 2"] | None:
        """Return the fitted gains' deviation, scaled like them."""
        known = self.field.deviation(contacts.double() / self.length, directions)
        return None if known is None else (known.double() * self.scale.abs()[:, None]).float()

    def record(self) -> dict[str, Any]:
        """Return the fitted field's record, what a file calls that field, and the length."""
        return {**self.field.record(), "fitted_kind": self.field.kind, "size_factor": self.length}

    def tensors(self) -> dict[str, Tensor]:
        """Return the factors and the fitted field's tensors."""
        return {"mode_factors": self.scale, **{_INNER + name: tensor for name, tensor in self.field.tensors().items()}}

    @classmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors like those of a field of these sizes."""
        if not 0.0 < like(record["size_factor"], 1.0, "size_factor") < math.inf:
            raise RecordError.expected("a number above 0", record["size_factor"], name="size_factor")
        inner = FITTED[_inner(record)].skeleton(record)
        scale = torch.empty(count_of(record["modes"], "modes"), dtype=torch.float64, device="meta")
        return {"mode_factors": scale, **{_INNER + name: tensor for name, tensor in inner.items()}}

    @classmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "ScaledGains":
        """Return the field."""
        inner = {name.removeprefix(_INNER): each for name, each in tensors.items() if name.startswith(_INNER)}
        return cls(FITTED[_inner(record)].restore(record, inner), tensors["mode_factors"], float(record["size_factor"]))

    def _edited(self, known: Gains) -> Gains:
        quadrature = None if known.quadrature is None else self._scaled(known.quadrature)
        return Gains(self._scaled(known.mean), quadrature, known.damping)

    def _scaled(self, gains: Float[Tensor, "contacts modes"]) -> Float32[Tensor, "contacts modes"]:
        return (gains.double() * self.scale).float()


def fitted_gains(gains: GainField) -> GainField:
    """Return gains as they were fitted, beneath all edits."""
    return gains.field if isinstance(gains, ScaledGains) else gains


def body_of(gains: GainField) -> ElasticModes | None:
    """Return the body whose mode shapes the fitted gains know, of the size before all edits; None without one."""
    fitted = fitted_gains(gains)
    return fitted.body if isinstance(fitted, MixtureGains | BodyGains) else None


def surface_of(gains: GainField) -> Surface | None:
    """Return the surface of the body that gains are computed on (object frame, meters); None without a body."""
    body = body_of(gains)
    return None if body is None else Surface(length_of(gains) * body.nodes.float(), body.triangles[:, :3])


def length_of(gains: GainField) -> float:
    """Return lengths on the object of edited gains over those on the object that they were fitted to."""
    return gains.length if isinstance(gains, ScaledGains) else 1.0


def _inner(record: Mapping[str, Any]) -> str:
    kind: str = like(record["fitted_kind"], "", "fitted_kind")
    if kind not in FITTED:
        raise RecordError(f"fitted_kind: expected {', '.join(FITTED)}, got {kind!r}", name="fitted_kind", value=kind)
    return kind
