"""Gains of a body that nobody recorded: its elastic mode shapes, each times how loud the mode is."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from avmsf._utils.records import count_of
from avmsf._utils.summary import short_repr
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.elastic_store import mode_sizes, mode_skeleton, mode_tensors, restored_modes
from avmsf.field.gain_field import GainField, Gains
from avmsf.field.gains.family import sites_along


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
