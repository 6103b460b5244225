"""AdamW's steps (Loshchilov and Hutter, ICLR 2019) without torch's class for them.

That class imports torch's compiler when it is first made, which takes two to three seconds, a sixth of a fit. Torch
has the same computation as a function; groups and moments, which it leaves to its caller, are kept here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.optim.adamw import adamw

_BETAS = 0.9, 0.999
_LEAST = 1e-8


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters that move alike."""

    parameters: Sequence[nn.Parameter]
    rate: float
    """Length of a step at first."""
    weight_decay: float = 0.0
    """Part of the rate by which parameters shrink at each step."""


class Descent:
    """Groups of parameters on their way down, with the means of their slopes and of their squares."""

    def __init__(self, groups: Sequence[Group]) -> None:
        self.groups = tuple(groups)
        self._known = [_Moments.of(group.parameters) for group in self.groups]

    def forget_slopes(self) -> None:
        """Take the parameters' gradients away."""
        for group in self.groups:
            for parameter in group.parameters:
                parameter.grad = None

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Move all parameters that have gradients, at `factor` times their groups' rates."""
        for group, known in zip(self.groups, self._known, strict=True):
            rows = [row for row, parameter in enumerate(group.parameters) if parameter.grad is not None]
            slopes = [parameter.grad for parameter in group.parameters if parameter.grad is not None]
            adamw(
                [group.parameters[row] for row in rows],
                slopes,
                [known.means[row] for row in rows],
                [known.squares[row] for row in rows],
                [],
                [known.steps[row] for row in rows],
                amsgrad=False,
                beta1=_BETAS[0],
                beta2=_BETAS[1],
                lr=factor * group.rate,
                weight_decay=group.weight_decay,
                eps=_LEAST,
                maximize=False,
            )

    def state(self) -> list[dict[str, Any]]:
        """Return all that changes, beside the parameters."""
        return [{"means": known.means, "squares": known.squares, "steps": known.steps} for known in self._known]

    def resume(self, state: list[dict[str, Any]]) -> None:
        """Go back to what `state` returned."""
        self._known = [
            _Moments(**{name: [tensor.clone() for tensor in tensors] for name, tensors in each.items()})
            for each in state
        ]


@dataclass(frozen=True, eq=False)
class _Moments:
    """What is known of the slopes of a group's parameters."""

    means: list[torch.Tensor]
    squares: list[torch.Tensor]
    steps: list[torch.Tensor]

    @classmethod
    def of(cls, parameters: Sequence[nn.Parameter]) -> "_Moments":
        means = [torch.zeros_like(each, requires_grad=False) for each in parameters]
        return cls(means, [each.clone() for each in means], [torch.zeros(()) for _ in parameters])
