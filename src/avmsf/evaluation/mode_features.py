"""Sets of modes as vectors of one length, by which `avmsf.evaluation.mode_embedding` compares them.

The paper compares objects by their modal frequencies in a UMAP and does not say how sets of different sizes become
points. Here a vector's Euclidean length is in octaves: a set with all frequencies doubled lies at a distance of 1 from
the one it was made of. The order of the modes does not matter, and neither does their number by itself.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank


class ModeFeatures(ABC):
    """A way to describe a set of modes by a vector."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What reports call it."""

    @abstractmethod
    def vector(self, bank: ModalBank) -> Float64[np.ndarray, " dim"]:
        """Return the vector of a set of modes. Raises EvaluationError for a set that is empty or not of numbers."""

    def record(self) -> dict[str, Any]:
        """Return its name and settings, as a file holds them."""
        return {"name": self.name, **asdict(self)}  # type: ignore[call-overload]


@dataclass(frozen=True)
class Pitches(ModeFeatures):
    """The frequencies alone, as in the paper: evenly spaced quantiles of their logarithms.

    Component k of n is the quantile (k + 1/2) / n of log2 f by Hazen's rule, over sqrt(n), so that the distance of two
    sets is the root mean square of their quantiles' differences in octaves.
    """

    count: int = 32
    """Quantiles."""

    @property
    def name(self) -> str:
        """What reports call it."""
        return "pitches"

    def vector(self, bank: ModalBank) -> Float64[np.ndarray, " dim"]:
        """Return the quantiles."""
        frequency, _ = _logarithms(bank)
        places = (np.arange(self.count) + 0.5) / self.count
        return np.quantile(frequency, places, method="hazen") / math.sqrt(self.count)


@dataclass(frozen=True)
class PitchesAndRings(ModeFeatures):
    """The frequencies, and beside them how fast each pitch dies away.

    Frequencies alone hardly tell materials apart: sound runs equally fast, to 6 %, in ceramic, glass, iron and steel,
    and an object of twice the size is an octave lower. How fast they ring out does. After the quantiles of `Pitches`
    follows, at evenly spaced pitches, log2 of the damping there, the mean over all modes weighted by
    exp(-(distance in octaves / width)^2 / 2), over the square root of their number.
    """

    count: int = 32
    """Quantiles."""
    rings: int = 15
    """Pitches at which dampings are compared, from 125 Hz to 16 kHz: two an octave."""
    width: float = 0.5
    """Octaves."""

    @property
    def name(self) -> str:
        """What reports call it."""
        return "pitches and rings"

    def vector(self, bank: ModalBank) -> Float64[np.ndarray, " dim"]:
        """Return the quantiles and the dampings."""
        frequency, damping = _logarithms(bank)
        places = np.linspace(math.log2(125.0), math.log2(16000.0), self.rings)
        exponent = -0.5 * ((frequency[None] - places[:, None]) / self.width) ** 2
        # Relative to the nearest mode's, lest all weights vanish far away from every mode.
        weights = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        curve = weights @ damping / weights.sum(axis=1)
        return np.concatenate([Pitches(self.count).vector(bank), curve / math.sqrt(self.rings)])


KINDS = {"pitches": Pitches, "pitches and rings": PitchesAndRings}
"""Classes by the names in their records."""


def features_of(record: dict[str, Any]) -> ModeFeatures:
    """Return the features that a record describes. Raises ValueError, TypeError or KeyError for any other record."""
    settings = dict(record)
    return KINDS[settings.pop("name")](**settings)


def _logarithms(bank: ModalBank) -> tuple[Float64[np.ndarray, " modes"], Float64[np.ndarray, " modes"]]:
    """Return log2 of frequencies and dampings."""
    if not len(bank):
        raise EvaluationError("expected a bank of one mode or more, got none", name="bank", value=0)
    both = torch.stack([bank.frequency, bank.damping])
    wrong = torch.nonzero(~(torch.isfinite(both) & (both > 0)))
    if len(wrong):
        which, row = wrong[0].tolist()
        name = ("frequency", "damping")[which]
        value = float(both[which, row])
        raise EvaluationError(f"mode {row}: expected a {name} above 0, got {value:g}", row=row, name=name, value=value)
    frequency, damping = torch.log2(both).numpy()
    return frequency, damping
