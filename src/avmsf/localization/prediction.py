"""Predicted gains of impacts at points, mode by mode, and the variance of their errors."""

from collections.abc import Callable
from statistics import NormalDist

import torch
from jaxtyping import Complex64, Float, Float32, Int
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.sound_field import SoundField
from avmsf.field.uncertainty import fitted_mixture, has_posterior

_BATCH = 2048
"""Points whose gains are asked for at once."""
_NEIGHBORS = 8
"""Nearest points from which the variance of gains around a point is estimated."""
_PATCH = 1.0 / 9.0
"""Variance over a square of surface around a point, over the mean square difference from the squares about it."""
_LEVEL = 0.9
"""Part of the gains that intervals are to hold."""
_MIN_CONTACTS = 3
"""Contacts from which on a field's errors are estimated by leave-one-out."""


def can_self_calibrate(field: SoundField) -> bool:
    """Return whether a field's own contacts suffice to estimate its errors elsewhere."""
    return has_posterior(field) and len(fitted_mixture(field).contacts) >= _MIN_CONTACTS


def calibration_factor(field: SoundField) -> float:
    """Return the factor that calibrates a field's posterior standard deviations; 1 where there are too few contacts.

    With it intervals of 90 % contain 90 % of the gains at contacts left out, each part of each mode counted alike: weak
    modes, whose deviations are too small, count as much in a position's likelihood as strong ones.
    """
    if not can_self_calibrate(field):
        return 1.0
    errors = fitted_mixture(field).standardized_errors().abs()
    return float(torch.nanquantile(errors.flatten(), _LEVEL)) / NormalDist().inv_cdf(0.5 + _LEVEL / 2.0)


def predict(
    sound_field: SoundField,
    points: Float[Tensor, "points 3"],
    directions: Float[Tensor, "points 3"] | None = None,
    *,
    factor: float | None = None,
) -> tuple[Complex64[Tensor, "points modes"], Float32[Tensor, "points modes"], Float32[Tensor, "points modes"] | None]:
    """Return gains, their posterior variance, and the factors on dampings.

    Gains are amplitudes of sines, and of cosines as imaginary part. The deviations are multiplied by `factor`; the
    variance is zero without it and without a posterior.
    """
    turned = torch.polar(torch.ones_like(sound_field.phase), sound_field.phase).to(torch.complex64)
    gains, variances, dampings = [], [], []
    for rows in torch.split(torch.arange(len(points)), _BATCH):
        place = points[rows], None if directions is None else directions[rows]
        with torch.no_grad():
            known = sound_field.gain_field.at(*place)
            deviation = None if factor is None else sound_field.gain_field.deviation(*place)
        if factor is None or deviation is None:
            variances.append(torch.zeros(known.mean.shape))
        else:
            variances.append((factor * deviation).square().sum(2).float())
        ahead = torch.zeros_like(known.mean) if known.quadrature is None else known.quadrature
        gains.append(torch.complex(known.mean.float(), ahead.float()) * turned)
        if known.damping is not None:
            dampings.append(known.damping.float())
    return torch.cat(gains), torch.cat(variances), torch.cat(dampings) if dampings else None


def local_variance(
    points: Float[Tensor, "points 3"],
    gains: Callable[[Int[Tensor, " some"]], Complex64[Tensor, "some modes"]],
    rows: Int[Tensor, " rows"] | None = None,
) -> Float32[Tensor, "rows modes"]:
    """Return the variance of gains over the patch of surface that each point, or each of some, represents.

    `gains` returns those of points of given rows.
    """
    chosen = torch.arange(len(points)) if rows is None else rows
    count = min(_NEIGHBORS, len(points) - 1)
    if count < 1:
        return torch.zeros(gains(chosen).shape)
    places = points.double().numpy()
    near = torch.from_numpy(cKDTree(places).query(places[chosen.numpy()], k=count + 1)[1][:, 1:])
    needed, of = torch.unique(torch.cat([chosen[:, None], near], dim=1), return_inverse=True)
    known = gains(needed)
    total = torch.zeros(len(chosen), known.shape[1])
    for other in of[:, 1:].T:
        total += (known[other] - known[of[:, 0]]).abs().square()
    return total * (_PATCH / count)
