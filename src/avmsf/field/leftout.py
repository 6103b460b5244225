"""Leave-one-out predictions of gains in closed form: nothing is solved again for each contact."""

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.hypotheses import Hypotheses


def left_out(
    known: Hypotheses,
    weights: Float64[Tensor, "hypotheses modes 2"],
    places: Int[Tensor, " contacts"] | None = None,
) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
    """Return each gain minus its prediction from all other contacts, and the standard deviation of that difference.

    Contacts of the same number in `places` are left out together; without it, each contact by itself. Hypotheses are
    weighted by the evidence of the other gains alone, with the same prior; their kernels stay the same. The deviation
    is that of a measured gain, noise included. `weights` are those with all gains.
    """
    apart = torch.arange(len(known.values)) if places is None else places
    parts = [torch.nonzero(apart == place).flatten() for place in torch.unique(apart)]
    found = [_left_out(known, weights[:, modes], modes, parts) for modes in known.batches()]
    return torch.cat([missed for missed, _ in found], dim=1), torch.cat([spread for _, spread in found], dim=1)


def _left_out(
    known: Hypotheses,
    weights: Float64[Tensor, "hypotheses modes 2"],
    modes: Int[Tensor, " modes"],
    parts: list[Int[Tensor, " _rows"]],
) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
    """Return the same of some modes, for contacts left out part by part.

    With B the block of the inverse covariance C^-1 that belongs to a part, the error is B^-1 (C^-1 y), where that is of
    the part's rows alone, and the covariance of the part given all others is B^-1 (Rasmussen and Williams, Gaussian
    Processes for Machine Learning, 2006, equations 5.10 to 5.12, for several rows).
    """
    inverse, values = torch.cholesky_inverse(known.factor(modes)), known.values[:, modes]
    solved = inverse @ values.transpose(0, 1)
    tiny = torch.finfo(torch.float64).tiny
    whole, silent = known.squares(modes, solved), torch.log(known.noise(modes)) * ~known.heard
    missed, spread = torch.empty_like(values), torch.empty_like(values)
    for rows in parts:
        block, along = inverse[..., rows[:, None], rows], solved[:, :, rows]
        covariance = torch.linalg.inv(block)
        error = covariance @ along
        rest = (whole - (along * error).sum(2)).clamp_min(tiny)
        others = max(known.count - int(known.heard[rows].sum()), 1)
        # A determinant without the part has the block's as a factor; excluded contacts are not part of the
        # evidence (`Hypotheses.likelihood`), so their noise term is subtracted too.
        change = known.count * torch.log(whole) - others * torch.log(rest)
        change = change - (torch.logdet(block) + silent[..., rows].sum(-1))[..., None]
        likely = torch.softmax(torch.log(weights) + 0.5 * change, dim=0)[:, :, None]
        variance = rest[:, :, None] / others * torch.diagonal(covariance, dim1=-2, dim2=-1)[..., None]
        middle = (likely * error).sum(0)
        square = (likely * (variance + error.square())).sum(0) - middle.square()
        missed[rows], spread[rows] = middle.transpose(0, 1), square.clamp_min(tiny).sqrt().transpose(0, 1)
    return missed, spread
