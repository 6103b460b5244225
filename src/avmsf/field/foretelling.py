"""What weighed hypotheses foretell of gains: their mean elsewhere, and how far from it they may be.

`weights`, everywhere, says how likely each hypothesis is of each part of each mode's gains; they sum to one.
"""

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.hypotheses import MEMORY, NOISES, REMAINDERS, WIDTHS, Hypotheses, rows_of


def expansion(
    known: Hypotheses, weights: Float64[Tensor, "hypotheses modes 2"]
) -> tuple[Float64[Tensor, "shapes modes 2"], Float64[Tensor, "contacts modes 2"]]:
    """Return the weights of the elastic shapes, and of the remainder's kernels at the contacts, in the mean gains."""
    shapes, kernels = [], []
    part = torch.tensor(REMAINDERS, dtype=torch.float64).reshape(1, -1, 1, 1, 1, 1)
    for modes in known.batches():
        weighed = weights[:, modes].unsqueeze(2) * known.solve(modes, known.factor(modes))
        parts = weighed.reshape(len(WIDTHS), len(REMAINDERS), len(NOISES), *weighed.shape[1:])
        along = torch.einsum("ck,wpqmcd->wmkd", known.sites.shapes, (1.0 - part) * parts)
        shapes.append(torch.einsum("wmkd,mwk->kmd", along, known.scaled_prior(modes)))
        kernels.append(torch.einsum("wpqmcd->cmd", part * parts))
    return torch.cat(shapes, dim=1), torch.cat(kernels, dim=1)


def standard_error(
    known: Hypotheses, weights: Float64[Tensor, "hypotheses modes 2"]
) -> Float64[Tensor, "contacts modes 2"]:
    """Return the standard error of the gains at the contacts."""
    found = []
    for modes in known.batches():
        scale = known.squares(modes, known.solve(modes, known.factor(modes))) / known.count
        weighed = (weights[:, modes] * scale).unsqueeze(2) * known.noise(modes)[..., None]
        found.append(weighed.sum(0).transpose(0, 1))
    return torch.cat(found, dim=1).sqrt()


def smoother(
    known: Hypotheses, weights: Float64[Tensor, "hypotheses modes 2"]
) -> Float64[Tensor, "modes 2 contacts contacts"]:
    """Return what each contact's gain counts for at each contact, in the mean gains."""
    found = []
    for modes in known.batches():
        # Without its noise the covariance is what the field has; (C - N) C^-1 = 1 - N C^-1.
        solved = known.noise(modes)[..., None] * torch.cholesky_inverse(known.factor(modes))
        found.append(torch.einsum("hmd,hmce->mdce", weights[:, modes], solved))
    return torch.eye(len(known.values), dtype=torch.float64) - torch.cat(found)


def deviation(
    known: Hypotheses,
    weights: Float64[Tensor, "hypotheses modes 2"],
    shapes: Float64[Tensor, "places shapes"],
    across: Float64[Tensor, "places contacts"],
    own: Float64[Tensor, " places"],
) -> Float64[Tensor, "places modes 2"]:
    """Return the standard deviation of the gains at places, within hypotheses and between them.

    `shapes` as in `Sites`, `across` the remainder's kernel between places and contacts, `own` that of each place with
    itself. So many places at once as `MEMORY` holds.
    """
    found = torch.empty(len(shapes), known.prior.shape[0], 2, dtype=torch.float64)
    for mode in range(known.prior.shape[0]):
        modes = torch.tensor([mode])
        kept = torch.nonzero(weights[:, mode].sum(1) > 0).flatten()
        factor = known.factor(modes, kept)
        solved = known.solve(modes, factor)
        scale = known.squares(modes, solved)[:, 0] / known.count
        width, remainder, _ = rows_of(kept)
        prior = known.scaled_prior(modes)[0][width]
        part = torch.tensor(REMAINDERS, dtype=torch.float64)[remainder]
        weight, most = weights[kept, mode], max(1, MEMORY // (len(kept) * sum(known.sites.shapes.shape)))
        for rows in torch.split(torch.arange(len(shapes)), most):
            elastic = torch.einsum("pk,hk,ck->hpc", shapes[rows], prior, known.sites.shapes)
            cross = (1 - part)[:, None, None] * elastic + part[:, None, None] * across[rows]
            alone = (1 - part)[:, None] * (prior @ shapes[rows].square().T) + part[:, None] * own[rows]
            half = torch.linalg.solve_triangular(factor[:, 0], cross.mT, upper=False)
            within = (alone - half.square().sum(1)).clamp_min(0.0)
            mean = cross @ solved[:, 0]
            squares = torch.einsum("hd,hpd->pd", weight, scale[:, None] * within[..., None] + mean.square())
            middle = torch.einsum("hd,hpd->pd", weight, mean)
            found[rows, mode] = (squares - middle.square()).clamp_min(0.0).sqrt()
    return found


def posterior(
    known: Hypotheses,
    hypothesis: Int[Tensor, " one"],
    mode: int,
    shapes: Float64[Tensor, "places shapes"],
    across: Float64[Tensor, "places contacts"],
    among: Float64[Tensor, "places places"],
) -> tuple[Float64[Tensor, "places places"], float]:
    """Return the covariance of one mode's gains among places, and the variance that one more blow has of its own.

    By one hypothesis, both summed over the gains' two parts. `shapes` as in `Sites`, `across` the remainder's kernel
    between places and contacts, `among` between places.
    """
    modes = torch.tensor([mode])
    width, remainder, noise = (int(each) for each in rows_of(hypothesis))
    prior, part = known.scaled_prior(modes)[0, width], REMAINDERS[remainder]
    cross = (1.0 - part) * (shapes * prior) @ known.sites.shapes.T + part * across
    alone = (1.0 - part) * (shapes * prior) @ shapes.T + part * among
    factor = known.factor(modes, hypothesis)
    half = torch.linalg.solve_triangular(factor[0, 0], cross.T, upper=False)
    scale = float(known.squares(modes, known.solve(modes, factor)).sum()) / known.count
    return scale * (alone - half.T @ half), scale * (NOISES[noise] + float(known.floor[:, mode].mean()))
