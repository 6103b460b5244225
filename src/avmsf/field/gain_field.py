"""What every gain field is: gains at contacts, their standard deviation, and nothing about time."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class Gains:
    """How strongly impacts at some contacts excite each mode."""

    mean: Float[Tensor, "contacts modes"]
    """Signed amplitudes of what starts with each mode's phase, in the unit of the training sounds."""
    quadrature: Float[Tensor, "contacts modes"] | None = None
    """Signed amplitudes of what is a quarter of a period ahead of that; None where there is nothing of it."""
    damping: Float[Tensor, "contacts modes"] | None = None
    """Factors on the modes' dampings; None where these are the same everywhere."""

    @property
    def parts(self) -> Float64[Tensor, "contacts modes 2"]:
        """The gains and the quadrature."""
        quadrature = torch.zeros_like(self.mean) if self.quadrature is None else self.quadrature
        return torch.stack([self.mean, quadrature], dim=2).double()

    @property
    def power(self) -> Float64[Tensor, "contacts modes"]:
        """Squares of the amplitudes whatever their phase, gains and quadrature together."""
        return self.parts.square().sum(2)

    def energy(self, damping: Float64[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
        """Return each mode's energy over time, gain^2 / (4 d), as the mean over the contacts; damping d in 1/s."""
        return (self.power / (4.0 * (damping if self.damping is None else damping * self.damping))).mean(0)


class GainField(ABC):
    """Gains at every contact with one object. One contract test holds for all subclasses."""

    kind: ClassVar[str]
    """What a file calls it."""

    points: Float[Tensor, "points 3"]
    """Points of the object's surface, object frame, meters: where pictures and searches look."""

    @abstractmethod
    def at(self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None) -> Gains:
        """Return the gains of impacts at contacts (object frame, meters).

        `directions` are the unit vectors along which the hammer moves. Fields that know of directions take an impact
        straight into the surface where none are given; the others ignore them.
        """

    def point_estimate(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Gains:
        """Return the gains that sounds are rendered with: those of `at`, except for a posterior whose mean cancels.

        Sounds are compared by magnitudes. Where hypotheses agree that a mode is loud but not on its sign, the mean is
        near zero, and the magnitude that they expect serves better.
        """
        return self.at(contacts, directions)

    def deviation(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts modes 2"] | None:
        """Return the posterior standard deviation of the gains and of the quadrature, without measurement noise.

        None for a field without a posterior.
        """
        return None

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what a file holds besides the tensors, as plain values, sizes included, that of `modes` among them."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Return what a file holds, by name."""

    @classmethod
    @abstractmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors on the device `meta`, of the names, shapes and dtypes that belong to a record.

        Raises RecordError, ValueError, TypeError or KeyError for a record that belongs to no such field.
        """

    @classmethod
    @abstractmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "GainField":
        """Return the field of a record and the tensors that belong to it."""


class TrainableGains(nn.Module):
    """A gain field in training. Its matrices decay towards zero as the config asks for, other parameters do not."""

    @property
    def report(self) -> dict[str, Any]:
        """What it chose before the training, as plain values."""
        return {}

    def used_rows(self, contacts: int) -> list[int]:
        """Return which of the contacts it was started from, as many as `contacts`, are to be trained on."""
        return list(range(contacts))

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at the contacts that `Targets.rows` stands for, differentiable in the parameters."""
        raise NotImplementedError

    def penalty(self) -> Float[Tensor, ""]:
        """Return the negative log prior of the parameters, in the unit of the spectral loss."""
        return torch.zeros(())

    def finished(self, order: Int[Tensor, " modes"]) -> GainField:
        """Return the gain field as it is, with its modes in the given order."""
        raise NotImplementedError
