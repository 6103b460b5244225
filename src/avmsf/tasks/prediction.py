"""Predicted gains of impacts at points, and the calibrated standard deviations of their errors."""

from statistics import NormalDist

import torch
from jaxtyping import Complex64, Float, Float32
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.soundfield import SoundField
from avmsf.field.uncertainty import fitted_mixture, has_posterior

_BATCH = 2048
"""Points whose gains are asked for at once."""
_NEIGHBORS = 8
"""Of a point, by which it is told how gains vary about it."""
_PATCH = 1.0 / 9.0
"""Variance over a square of surface around a point, over the mean square difference from the squares about it."""
_LEVEL = 0.9
"""Part of the gains that intervals are to hold."""
_TOLD = 3
"""Contacts that a field needs to say how wrong it is."""


def judges_itself(field: SoundField) -> bool:
    """Return whether a field's own strikes tell how wrong it is where it was not struck."""
    return has_posterior(field) and len(fitted_mixture(field).contacts) >= _TOLD


def widened(field: SoundField) -> float:
    """Return the factor on a field's deviations with which they hold what it does not know; 1 where that is unknown.

    With it intervals of 90 % hold so many of the gains at contacts left out, each part of each mode counted alike: weak
    modes, whose deviations are too small, count as much in a place's likelihood as strong ones.
    """
    if not judges_itself(field):
        return 1.0
    errors = fitted_mixture(field).standardized_errors().abs()
    return float(torch.nanquantile(errors.flatten(), _LEVEL)) / NormalDist().inv_cdf(0.5 + _LEVEL / 2.0)


def predict(
    sound_field: SoundField, points: Float[Tensor, "points 3"], directions: Float[Tensor, "points 3"] | None
) -> tuple[Complex64[Tensor, "points modes"], Float32[Tensor, "points modes"] | None]:
    """Return gains, amplitudes of sines and of cosines as imaginary part, and the factors on dampings."""
    turned = torch.polar(torch.ones_like(sound_field.phase), sound_field.phase).to(torch.complex64)
    gains, dampings = [], []
    for rows in torch.split(torch.arange(len(points)), _BATCH):
        with torch.no_grad():
            known = sound_field.gain_field.at(points[rows], None if directions is None else directions[rows])
        ahead = torch.zeros_like(known.mean) if known.quadrature is None else known.quadrature
        gains.append(torch.complex(known.mean.float(), ahead.float()) * turned)
        if known.damping is not None:
            dampings.append(known.damping.float())
    return torch.cat(gains), torch.cat(dampings) if dampings else None


def unknown(
    sound_field: SoundField,
    points: Float[Tensor, "points 3"],
    directions: Float[Tensor, "points 3"] | None,
    *,
    factor: float,
) -> Float32[Tensor, "points modes"]:
    """Return the variance of what the field does not know of its gains, its deviations times `factor`."""
    variances = []
    for rows in torch.split(torch.arange(len(points)), _BATCH):
        with torch.no_grad():
            deviation = sound_field.gain_field.deviation(points[rows], None if directions is None else directions[rows])
        if deviation is None:
            return torch.zeros(len(points), len(sound_field.bank))
        variances.append((factor * deviation).square().sum(2).float())
    return torch.cat(variances)


def patches(
    points: Float[Tensor, "points 3"], gains: Complex64[Tensor, "points modes"]
) -> Float32[Tensor, "points modes"]:
    """Return the variance of gains over the patch of surface that each point stands for."""
    count = min(_NEIGHBORS, len(points) - 1)
    total = torch.zeros(gains.shape)
    if count < 1:
        return total
    places = points.double().numpy()
    _, rows = cKDTree(places).query(places, k=count + 1)
    for near in torch.from_numpy(rows[:, 1:].T.copy()):
        total += (gains[near] - gains).abs().square()
    return total * (_PATCH / count)
