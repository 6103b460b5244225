"""Gains interpolated smoothly between the training contacts: the strong baseline that reads positions alone."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.bench.modalbaseline import ModalBaseline
from avmsf.field.thinplate import Spline, fit_spline


@dataclass(frozen=True, eq=False)
class SplineGains(ModalBaseline):
    """The modes with gains in phase and in quadrature that are thin-plate splines over the training contacts.

    All gains are smoothed alike, each mode counting by the energy of its sound.
    """

    def amplitudes_at(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts two_modes"]:
        """Return the splines' gains in phase, then in quadrature."""
        return self.spline.at(contacts).to(self.amplitudes)

    @cached_property
    def spline(self) -> Spline:
        """The gains in phase, then in quadrature, as a function of place."""
        # A gain g sounds with the energy g^2 / (4 d).
        energy = 1 / (4 * self.bank.damping)
        return fit_spline(self.train.contacts, self.amplitudes, importance=torch.cat([energy, energy]))

    @property
    def report(self) -> dict[str, Any]:
        """What the spline is, as plain values: its kernel, directions, distinct contacts and smoothing."""
        sites = self.spline.sites
        return {
            "kernel": "thin plate" if sites.bending else "distance",
            "directions": sites.sites.shape[1],
            "sites": sites.sites.shape[0],
            "smoothing": sites.smoothing,
        }
