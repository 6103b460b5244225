"""The gains at the training contacts, refined end to end through the gain model's smoother."""

from dataclasses import replace

import torch
from jaxtyping import Complex128, Float, Int
from torch import Tensor, nn

from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains, complex_of
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
        # All tensors are [series, contacts, 1], series as in the mixture.
        smoother, values = model.mixture.smoother(), model.mixture.values.T[..., None]
        self.smoother, self.start = nn.Buffer(smoother.float()), nn.Buffer((smoother @ values).float())
        self.noise = nn.Buffer(model.mixture.standard_error().float()[:, None, None])
        energy = values.reshape(2, len(bank), -1).square().sum((0, 2)) / bank.damping
        self.share = nn.Buffer((energy / energy.sum().clamp_min(torch.finfo(torch.float64).tiny)).float())
        self.shift = nn.Parameter(torch.zeros_like(self.start))

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at some of the model's contacts."""
        smoothed = self.start + self.smoother @ (self.noise * _STEP * self.shift)
        return Gains(complex_of(smoothed[:, rows, 0].T.contiguous()))

    def penalty(self) -> Float[Tensor, ""]:
        """Return the squared shifts over the squared standard errors, each mode by its part of the energy."""
        squares = (_STEP * self.shift).square().reshape(2, len(self.share), -1).mean((0, 2))
        return 0.5 * _STRENGTH * (squares * self.share).sum()

    def finished(
        self, order: Int[Tensor, " modes"], measured: Complex128[Tensor, "contacts modes"] | None = None
    ) -> MixtureGains:
        """Return the model of the gains as they stand, with its modes in the given order.

        It judges itself by the `measured` gains that these modes, in order, have in the recordings. Frequencies that
        moved end to end have turned their modes, which says nothing of the gains.
        """
        moved = (self.noise * _STEP * self.shift).detach().double()[..., 0].T
        model = self.model.with_values(self.model.values + complex_of(moved)).take(order)
        return model if measured is None else replace(model, measured=turned_like(measured, model.values))
