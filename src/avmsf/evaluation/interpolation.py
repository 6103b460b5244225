"""Gains interpolated smoothly between the training contacts: the strong baseline that reads positions alone."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.interpolate import RBFInterpolator
from torch import Tensor

from avmsf.capture.impacts import places_of
from avmsf.evaluation.modal_baselines import ModalBaseline
from avmsf.field.gains.positional import Axes


@dataclass(frozen=True, eq=False)
class SplineGains(ModalBaseline):
    """The modes with gains in phase and in quadrature that are thin-plate splines through the training contacts.

    Contacts in one place count once, with their mean gains. With fewer places than twice what determines a linear
    function the spline is linear in the distance, with a constant: the thin plate would run away beyond the contacts.
    """

    def amplitudes_at(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts two_modes"]:
        """Return the splines' gains in phase, then in quadrature."""
        places, means = self._places
        along, asked = self._axes.along(places), self._axes.along(contacts.double())
        if len(places) == 1 or not along.shape[1]:
            return means.mean(0, keepdim=True).expand(len(contacts), -1).to(self.amplitudes)
        kernel, degree = ("thin_plate_spline", 1) if self._bends else ("linear", 0)
        spline = RBFInterpolator(along.numpy(), means.numpy(), kernel=kernel, degree=degree)
        return torch.from_numpy(np.asarray(spline(asked.numpy()))).to(self.amplitudes)

    @property
    def report(self) -> dict[str, Any]:
        """What the spline is, as plain values: its kernel, directions and distinct places."""
        directions = self._axes.along(self._places[0]).shape[1]
        kernel = "thin plate" if self._bends else "distance"
        return {"kernel": kernel, "directions": directions, "sites": len(self._places[0])}

    @cached_property
    def _places(self) -> tuple[Float64[Tensor, "places 3"], Float64[Tensor, "places two_modes"]]:
        """Distinct places, and the mean gains there."""
        owner = places_of(self.train.contacts.double())
        members = (owner[None, :] == torch.arange(int(owner.max()) + 1)[:, None]).double()
        mean = members / members.sum(1, keepdim=True)
        return mean @ self.train.contacts.double(), mean @ self.amplitudes.double()

    @cached_property
    def _axes(self) -> Axes:
        return Axes(self._places[0])

    @property
    def _bends(self) -> bool:
        places = self._places[0]
        return len(places) >= 2 * (self._axes.along(places).shape[1] + 1)
