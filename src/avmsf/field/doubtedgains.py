"""Gain fields that know how sure they are: what they believe of gains together, and how well their contacts agree."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float, Float64
from torch import Tensor

from avmsf.field.gainfield import GainField


@dataclass(frozen=True, eq=False)
class Belief:
    """What is not known of the gains of one mode, or of several that differ by a factor."""

    covariance: Float64[Tensor, "places places"]
    """Between gains at places, as energy: summed over both parts of the gains and over modes, each by its weight."""
    scatter: float
    """What one more blow has of its own, likewise."""


@runtime_checkable
class DoubtedGains(GainField, Protocol):
    """A gain field with a posterior over gains, from the gains of the contacts that it was fitted to."""

    @property
    def contacts(self) -> Float64[Tensor, "contacts 3"]:
        """Where the gains are known, metres."""
        ...

    @property
    def places(self) -> int:
        """Separate places among the contacts; one place alone says nothing of how gains vary."""
        ...

    @property
    def values(self) -> Float64[Tensor, "contacts modes 2"]:
        """The gains at the contacts in two parts."""
        ...

    @property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of each of the two parts of the gains at the contacts."""
        ...

    @property
    def trusted(self) -> Bool[Tensor, " contacts"]:
        """Whether each contact is taken to be where its label says; the others' gains count for nothing."""
        ...

    def ways(
        self, places: Float[Tensor, "places 3"], directions: Float[Tensor, "places 3"] | None
    ) -> Float64[Tensor, "places 3"] | None:
        """Return the unit vectors along which blows at places count; None where their directions do not matter."""
        ...

    def beliefs(
        self,
        places: Float64[Tensor, "places 3"],
        ways: Float64[Tensor, "places 3"] | None,
        *,
        weights: Float64[Tensor, " modes"],
    ) -> Iterator[Belief]:
        """Return what is not known of the gains of blows at places, of modes whose squares count by `weights`."""
        ...

    def without(self, contacts: Bool[Tensor, " contacts"]) -> "DoubtedGains":
        """Return the field as if these contacts' gains were not known; what it learnt of its settings stays."""
        ...

    def left_out(self) -> Float64[Tensor, "sites modes 2"]:
        """Return by how much all others' gains miss each trusted contact's, over the deviation foretold of that.

        Contacts in one place may count as one. NaN for parts of modes without any gains.
        """
        ...
