"""Parameterizations of an edit: free quantities, learning rates, and penalties."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.editing.modal_edit import ModalEdit

_QUANTITIES = ("pitch", "shift", "damping", "damping_shift", "scale")


@dataclass(frozen=True)
class Parameterization:
    """Rates are those of Adam, in logarithms a step, falling to a twentieth; 0 fixes a quantity at its initial value.

    The penalty on a quantity of single modes is half the mean square over modes of its value over its standard
    deviation, times `stiffness`, in the unit of the loss, which is a relative error.
    """

    name: str
    """Name in the edit's report."""
    pitch_rate: float
    """Of the common factor on frequencies."""
    damping_rate: float
    """Of the common factor on dampings."""
    shift_rate: float
    """Of each frequency."""
    damping_shift_rate: float
    """Of each damping."""
    scale_rate: float
    """Of each gain factor."""
    stiffness: float
    """Weight of the penalty on single modes."""
    shift_deviation: float = 0.05
    """Standard deviation of single frequencies, logarithm: .05 is almost a semitone."""
    damping_shift_deviation: float = 0.3
    """Standard deviation of single dampings, logarithm."""
    scale_deviation: float = 1.0
    """Standard deviation of gain factors, logarithm, without the common level."""
    searches: bool = True
    """Whether the guide proposes the initial edit; otherwise the unedited object."""
    gains_follow: bool = False
    """Whether gains of a mode from f1 to f2 Hz are multiplied by f1 / f2 when the edit ends (paper, section 3.6)."""


HIERARCHICAL = Parameterization("hierarchical", 0.02, 0.02, 0.003, 0.01, 0.02, 0.05)
"""The paper's factor on all frequencies, and ours: one on all dampings, penalties on single modes, a search first."""
PUBLISHED = Parameterization("published", 0.02, 0.0, 0.003, 0.01, 0.02, 0.0, searches=False, gains_follow=True)
"""The paper's: f = exp(log alpha + log f0 + delta), dampings and gains of single modes, no penalty.

The rates, which the paper does not state, are those of `HIERARCHICAL`.
"""
INDEPENDENT = Parameterization("independent", 0.0, 0.0, 0.02, 0.02, 0.02, 0.0, searches=False)
"""The paper's baseline, after Audio-SDS: independent frequencies, dampings and gains, no common factors.

The rates are this package's, those of the common factors above; Audio-SDS states .05 for its parameters.
"""
SEARCHED = replace(INDEPENDENT, name="searched", searches=True)
"""Independent modes, initialized by the search for common factors: what remains is the effect of the hierarchy."""

PARAMETERISATIONS = {each.name: each for each in (HIERARCHICAL, PUBLISHED, INDEPENDENT, SEARCHED)}
"""All of them, by name."""


class EditVariables:
    """The variables of an edit, and their optimizer."""

    def __init__(self, start: ModalEdit, edited: Int[Tensor, " edited"], parameters: Parameterization) -> None:
        """Begin at `start`; the modes `edited` move by themselves, the others follow the common factors alone.

        Quantities whose rate is 0 stay where they begin.
        """
        self.parameters, self.modes, self.edited = parameters, len(start.shift), edited
        self.values: dict[str, Float64[Tensor, "*edited"]] = {}
        groups = []
        for name in _QUANTITIES:
            value: Tensor = getattr(start, name).detach().to(edited.device)
            rate = getattr(parameters, f"{name}_rate")
            chosen = value if value.ndim == 0 else value[edited]
            self.values[name] = chosen.clone().requires_grad_(rate > 0)
            if rate > 0:
                groups.append({"params": [self.values[name]], "lr": rate, "rate": rate})
        # Targets change from step to step: a long memory of the gradient's square would brake what chance once pushed.
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))

    def edit(self) -> ModalEdit:
        """Return the edit as it stands, differentiable in the values."""
        whole = {
            name: value if value.ndim == 0 else value.new_zeros(self.modes).index_put((self.edited,), value)
            for name, value in self.values.items()
        }
        return ModalEdit(**whole)

    def penalty(self) -> Float64[Tensor, ""]:
        """Return the penalty on single modes, in the unit of the loss."""
        parameters, scale = self.parameters, self.values["scale"]
        parts = (
            self.values["shift"] / parameters.shift_deviation,
            self.values["damping_shift"] / parameters.damping_shift_deviation,
            (scale - scale.mean()) / parameters.scale_deviation,
        )
        return 0.5 * parameters.stiffness * torch.stack([part.square().mean() for part in parts]).sum()

    def differentiate(self, loss: Float[Tensor, ""]) -> bool:
        """Take the gradient of a loss and the penalty; return whether it is finite."""
        self.optimizer.zero_grad()
        torch.autograd.backward(loss + self.penalty())
        moving = [value.grad for value in self.values.values() if value.grad is not None]
        return all(bool(torch.isfinite(gradient).all()) for gradient in moving)

    def move(self, *, done: float) -> None:
        """Take a step of the optimizer; `done` is the fraction of finished steps."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["rate"] * (0.525 + 0.475 * math.cos(math.pi * done))
        self.optimizer.step()

    def state(self) -> dict[str, Any]:
        """Return the complete state: tensors, numbers, containers of these."""
        values = {name: value.detach().cpu().clone() for name, value in self.values.items()}
        return {"values": values, "optimizer": self.optimizer.state_dict()}

    def resume(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        with torch.no_grad():
            for name, value in self.values.items():
                value.copy_(state["values"][name])
        self.optimizer.load_state_dict(state["optimizer"])
