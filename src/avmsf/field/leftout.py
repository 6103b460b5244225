"""By how much each contact's gains are missed by all others', without solving anew for each."""

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.hypotheses import Hypotheses


def left_out(
    known: Hypotheses, weights: Float64[Tensor, "hypotheses modes 2"]
) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
    """Return by how much each gain at a contact is missed by all others', and the deviation foretold of that.

    Hypotheses are weighed without the gain that is left out, by the same belief beforehand; the deviation is of a
    measured gain, noise and all. `weights` are those with all gains.
    """
    found = [_left_out(known, weights[:, modes], modes) for modes in known.batches()]
    return torch.cat([missed for missed, _ in found], dim=1), torch.cat([spread for _, spread in found], dim=1)


def _left_out(
    known: Hypotheses, weights: Float64[Tensor, "hypotheses modes 2"], modes: Int[Tensor, " modes"]
) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
    inverse = torch.cholesky_inverse(known.factor(modes))
    alone = torch.diagonal(inverse, dim1=-2, dim2=-1)[..., None]
    solved = inverse @ known.values[:, modes].transpose(0, 1)
    count, tiny = known.count, torch.finfo(torch.float64).tiny
    whole = known.squares(modes, solved)[:, :, None]
    rest = (whole - solved.square() / alone).clamp_min(tiny)
    # A determinant without one row has the inverse's entry there as a factor.
    change = 0.5 * (count * torch.log(whole) - (count - 1) * torch.log(rest) - torch.log(alone))
    likely = torch.softmax(torch.log(weights)[:, :, None] + change, dim=0)
    missed, variance = solved / alone, rest / (max(count - 1, 1) * alone)
    middle = (likely * missed).sum(0)
    spread = (likely * (variance + missed.square())).sum(0) - middle.square()
    return middle.transpose(0, 1), spread.clamp_min(tiny).sqrt().transpose(0, 1)
