"""The gains at the training contacts, refined end to end through the gain model's smoother."""

from dataclasses import replace

import torch
from jaxtyping import Complex128, Float, Float64, Int
from torch import Tensor, nn

from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains
from avmsf.field.training import TrainableGains
from avmsf.modal.modes import ModalBank, turned_like

_STEP = 200.0
"""Standard errors that a parameter of one stands for: a learning rate made for networks then moves gains in time."""
_STRENGTH = 0.1
"""Spectral loss that gains are worth which are off by one standard error each: about what it measures of them."""


class RefinedGains(TrainableGains):
    """A gain model whose measured gains may move, each as far as its standard error allows.

    With the hypotheses' weights kept, the mean gains are linear in the measured ones. So the gain model is the prior of
    the refinement too: gains move where the spectra of all recordings ask for it and the kernels allow it.
    """

    def __init__(self, model: MixtureGains, bank: ModalBank) -> None:
        """Start from the model of the modes of `bank`, whose energies say how much a gain matters."""
        super().__init__()
        self.model = model
        smoother, values = model.smoother(), torch.view_as_real(model.values)
        self.smoother, self.noise = nn.Buffer(smoother.float()), nn.Buffer(model.noise().float())
        self.start = nn.Buffer(_applied(smoother, values).float())
        energy = values.square().sum((0, 2)) / bank.damping
        self.share = nn.Buffer((energy / energy.sum().clamp_min(torch.finfo(torch.float64).tiny)).float())
        self.shift = nn.Parameter(torch.zeros_like(self.start))

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at some of the model's contacts."""
        parts = (self.start + _applied(self.smoother, self.noise * _STEP * self.shift))[rows]
        return Gains(torch.complex(parts[..., 0], parts[..., 1]))

    def penalty(self) -> Float[Tensor, ""]:
        """Return the squared shifts over the squared standard errors, each mode by its part of the energy."""
        squares = (_STEP * self.shift).square().mean((0, 2))
        return 0.5 * _STRENGTH * (squares * self.share).sum()

    def finished(
        self, order: Int[Tensor, " modes"], measured: Complex128[Tensor, "contacts modes"] | None = None
    ) -> MixtureGains:
        """Return the model of the gains as they stand, with its modes in the given order.

        It judges itself by the `measured` gains that these modes, in order, have in the recordings. Frequencies that
        moved end to end have turned their modes, which says nothing of the gains.
        """
        moved = (self.noise * _STEP * self.shift).detach().double()
        model = self.model.with_values(self.model.values + torch.view_as_complex(moved.contiguous())).take(order)
        if measured is None:
            return model
        return replace(model, measured=turned_like(measured, model.values))


def _applied(smoother: Tensor, values: Float64[Tensor, "contacts modes 2"] | Tensor) -> Tensor:
    """Return the smoothed values, part by part and mode by mode; both values are [contacts, modes, 2]."""
    return (smoother @ values.permute(1, 2, 0)[..., None]).squeeze(-1).permute(2, 0, 1)
