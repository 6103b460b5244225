"""Gains as Bayesian regression: what few elastic shapes near in frequency, a smooth remainder and noise can explain.

Every measured mode has the same `hypotheses`, each with its evidence. How likely a hypothesis is beforehand is learnt
from all modes together, by expectation maximisation, and the gains elsewhere are the mean over hypotheses of what each
foretells. So a mode whose own few gains say little of its noise borrows from the others (MacKay, Neural Computation 4,
1992; Tipping, JMLR 1, 2001, for the sparse forms that were tried before).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor

from avmsf.field import foretelling, leftout
from avmsf.field.hypotheses import COUNT, Hypotheses, Sites

_ROUNDS = 5
"""Of learning how likely hypotheses are beforehand."""
_PSEUDO = 0.1
"""Modes' worth of belief, each, in that all hypotheses are alike."""
_NEGLIGIBLE = 0.01
"""Weight under which a hypothesis is dropped."""


@dataclass(frozen=True, eq=False)
class Regression:
    """Hypotheses about each mode's gains, weighed by the gains at the contacts."""

    sites: Sites
    prior: Float64[Tensor, "modes widths shapes"]
    """Of `nearness`."""
    values: Float64[Tensor, "contacts modes 2"]
    """Gains at the contacts, in two parts that are independent of each other."""
    floor: Float64[Tensor, "contacts modes"]
    """As in `Hypotheses`."""
    doubt: Float64[Tensor, " contacts"]
    """As in `Hypotheses`."""
    weights: Float64[Tensor, "hypotheses modes 2"]
    """How likely each hypothesis is after all; they sum to one."""

    @classmethod
    def of(
        cls,
        sites: Sites,
        prior: Float64[Tensor, "modes widths shapes"],
        values: Float64[Tensor, "contacts modes 2"],
        *,
        floor: Float64[Tensor, "contacts modes"],
        doubt: Float64[Tensor, " contacts"],
    ) -> "Regression":
        """Weigh all hypotheses."""
        known = Hypotheses(sites, prior, values, floor, doubt)
        joint = _with_beliefs(torch.cat([known.likelihood(modes) for modes in known.batches()], dim=1))
        weights = torch.softmax(joint, dim=0)
        weights = torch.where(weights < _NEGLIGIBLE, 0.0, weights)
        return cls(sites, prior, values, floor, doubt, weights / weights.sum(0))

    @classmethod
    def evidence_of(
        cls,
        sites: Sites,
        priors: Float64[Tensor, "trials modes widths shapes"],
        values: Float64[Tensor, "contacts modes 2"],
        *,
        floor: Float64[Tensor, "contacts modes"],
        doubt: Float64[Tensor, " contacts"],
    ) -> Float64[Tensor, " trials"]:
        """Return the evidence of each of several priors, all at once: many are soon tried.

        It is the log of the likelihood of all gains, up to a constant of their number.
        """
        trials, modes = priors.shape[:2]
        known = Hypotheses(sites, priors.flatten(0, 1), values.repeat(1, trials, 1), floor.repeat(1, trials), doubt)
        single = torch.cat([known.likelihood(rows) for rows in known.batches()], dim=1)
        joint = _with_beliefs(single.reshape(COUNT, trials, modes, 2).movedim(1, 0))
        return torch.logsumexp(joint, dim=-3).sum((-2, -1))

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """What the weights are of."""
        return Hypotheses(self.sites, self.prior, self.values, self.floor, self.doubt)

    def take(self, modes: Int[Tensor, " modes"]) -> "Regression":
        """Return the regression of the given modes, in the given order."""
        return replace(
            self,
            prior=self.prior[modes],
            values=self.values[:, modes],
            floor=self.floor[:, modes],
            weights=self.weights[:, modes],
        )

    def with_values(self, values: Float64[Tensor, "contacts modes 2"]) -> "Regression":
        """Return the same hypotheses, as likely as before, on other gains."""
        return replace(self, values=values)

    @property
    def silent(self) -> Bool[Tensor, "modes 2"]:
        """Whether each part of each mode has no gains at all."""
        return self.hypotheses.silent

    @cached_property
    def expansion(self) -> tuple[Float64[Tensor, "shapes modes 2"], Float64[Tensor, "contacts modes 2"]]:
        """Weights of the elastic shapes, and of the remainder's kernels at the contacts, in the mean gains."""
        return foretelling.expansion(self.hypotheses, self.weights)

    @cached_property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of the gains at the contacts, as the hypotheses have it."""
        return foretelling.standard_error(self.hypotheses, self.weights)

    @cached_property
    def smoother(self) -> Float64[Tensor, "modes 2 contacts contacts"]:
        """What each contact's gain counts for at each contact, in the mean gains, for each part."""
        return foretelling.smoother(self.hypotheses, self.weights)

    @cached_property
    def left_out(self) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
        """By how much each gain at a contact is missed by all others', and the deviation foretold of that."""
        return leftout.left_out(self.hypotheses, self.weights)

    def deviation(
        self,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        own: Float64[Tensor, " places"],
    ) -> Float64[Tensor, "places modes 2"]:
        """Return the standard deviation of the gains at places, as `foretelling.deviation`."""
        return foretelling.deviation(self.hypotheses, self.weights, shapes, across, own)

    def posterior(
        self,
        mode: int,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        among: Float64[Tensor, "places places"],
    ) -> tuple[Float64[Tensor, "places places"], float]:
        """Return what `foretelling.posterior` does by the mode's likeliest hypothesis."""
        likeliest = (self.weights[:, mode] * self.values[:, mode].square().sum(0)).sum(1).argmax()
        return foretelling.posterior(self.hypotheses, likeliest[None], mode, shapes, across, among)


def _with_beliefs(
    single: Float64[Tensor, "*trials hypotheses modes 2"],
) -> Float64[Tensor, "*trials hypotheses modes 2"]:
    """Return the logs of the evidence of single modes, with how likely hypotheses are beforehand, learnt from all."""
    hypotheses, modes = single.shape[-3:-1]
    before = torch.full((hypotheses, 1, 2), -math.log(hypotheses), dtype=torch.float64)
    for _ in range(_ROUNDS):
        counts = torch.softmax(single + before, dim=-3).sum(-2, keepdim=True) + _PSEUDO * modes / hypotheses
        before = torch.log(counts / counts.sum(-3, keepdim=True))
    return single + before
