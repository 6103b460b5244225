"""Predicted gains of impacts at points, the variance of their errors, and how strongly these are correlated."""

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import torch
from jaxtyping import Complex64, Float, Float32, Float64
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.sound_field import SoundField
from avmsf.localization.likelihood import Likelihood, PredictedGains
from avmsf.mesh.points import farthest_points

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
    return field.has_posterior and len(field.fitted_mixture.contacts) >= _MIN_CONTACTS


def calibration_factor(field: SoundField) -> float:
    """Return the factor that calibrates a field's posterior standard deviations; 1 where there are too few contacts.

    With it intervals of 90 % contain 90 % of the gains at contacts left out, each part of each mode counted alike: weak
    modes, whose deviations are too small, count as much in a position's likelihood as strong ones.
    """
    if not can_self_calibrate(field):
        return 1.0
    errors = field.fitted_mixture.standardized_errors().abs()
    return float(torch.nanquantile(errors.flatten(), _LEVEL)) / NormalDist().inv_cdf(0.5 + _LEVEL / 2.0)


def predict(
    sound_field: SoundField,
    points: Float[Tensor, "points 3"],
    directions: Float[Tensor, "points 3"] | None = None,
    *,
    factor: float,
) -> tuple[Complex64[Tensor, "points modes"], Float32[Tensor, "points modes"], Float32[Tensor, "points modes"] | None]:
    """Return gains, their posterior variance, and the factors on dampings.

    Gains are amplitudes of sines, and of cosines as imaginary part. The deviations are multiplied by `factor`; the
    variance is zero without a posterior.
    """
    with torch.no_grad():
        known = sound_field.gain_field.posterior(points, directions)
    std, turn = known.std, torch.polar(torch.ones_like(sound_field.phase), sound_field.phase).to(torch.complex64)
    variance = torch.zeros(known.mean.shape) if std is None else (factor * std).square().sum(2).float()
    return known.mean.to(torch.complex64) * turn, variance, known.damping


def local_variance(
    points: Float[Tensor, "points 3"], gains: Complex64[Tensor, "points modes"]
) -> Float32[Tensor, "points modes"]:
    """Return the variance of gains over the patch of surface that each point represents."""
    count = min(_NEIGHBORS, len(points) - 1)
    total = torch.zeros(gains.shape)
    if count < 1:
        return total
    positions = points.double().numpy()
    near = torch.from_numpy(cKDTree(positions).query(positions, k=count + 1)[1][:, 1:])
    for other in near.T:
        total += (gains[other] - gains).abs().square()
    return total * (_PATCH / count)


# What a field of few contacts predicts at a position is often true of one nearby, in all modes at once, which the
# deviations of single modes do not contain. So the posterior is smoothed by a part of the distance between contacts.
POSITION_STD_PER_SPACING = 0.06
"""Standard deviation of a position over the distance between contacts, along each direction: measured on plates."""
_MAX_POSITION_STD = 0.03
"""The same over the object's diagonal, at most."""
_KERNEL_CUTOFF = 2.5
"""Standard deviations at which the kernel ends."""
_AREA_NEIGHBORS = 6


def distinct_contacts(field: SoundField) -> int | None:
    """Return how many contacts in different places a field was fitted to; None where that is not known."""
    gains = field.gain_field.fitted
    if isinstance(gains, MixtureGains):
        return gains.place_count
    return len(field.origin.trained_on) or None


def point_areas(points: Float[Tensor, "points 3"]) -> Float64[Tensor, " points"]:
    """Return the area of surface that falls to each of at least two points, square meters, by its neighbors."""
    places = points.double().numpy()
    count = min(_AREA_NEIGHBORS, len(places) - 1)
    distances, _ = cKDTree(places).query(places, k=count + 1)
    return torch.from_numpy(np.pi * distances[:, -1] ** 2 / (count + 0.5))


def smoothing_matrix(points: Float[Tensor, "points 3"], *, contacts: int | None) -> csr_array | None:
    """Return the kernel that smooths probabilities over neighboring points (meters); its columns sum to one.

    None for a field of unknown contacts, and for points that are all at one place.
    """
    if contacts is None or len(points) < 2:
        return None
    areas = point_areas(points)
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    off = min(POSITION_STD_PER_SPACING * math.sqrt(float(areas.sum()) / contacts), _MAX_POSITION_STD * diagonal)
    # A place may be anywhere in the square that a point stands for, before it is moved and after.
    deviation = math.sqrt(off**2 + float(areas.median()) / 6.0)
    if off <= 0.0:
        return None
    places = points.double().numpy()
    near = cKDTree(places).query_pairs(_KERNEL_CUTOFF * deviation, output_type="ndarray")
    weights = np.exp(-0.5 * ((places[near[:, 0]] - places[near[:, 1]]) ** 2).sum(1) / deviation**2)
    own = np.arange(len(places))
    rows, columns = np.concatenate([near[:, 0], near[:, 1], own]), np.concatenate([near[:, 1], near[:, 0], own])
    kernel = coo_array((np.concatenate([weights, weights, np.ones(len(own))]), (rows, columns))).tocsr()
    return (kernel / np.asarray(kernel.sum(axis=0))).tocsr()


_MAX_HOLDOUT = 12
"""Contacts that are left out, at most: those farthest apart."""
_POINTS = 300
"""Number of points of the surface at which the likelihood is computed, besides those nearest to the contacts."""
_FACTORS = torch.logspace(-2.0, 0.6, 27, dtype=torch.float64)
_LOG_PRIOR_STD = 1.0
"""Standard deviation of the factor's logarithm without any contact: e times as much or as little."""
_NOISE = 1e-10
"""Variance of the measured gains' own errors over the strongest one's square: they are taken as they are."""


def calibrate_tempering(field: SoundField) -> float:
    """Return the factor on `likelihood.INDEPENDENT` that a field's own contacts support best, .01 to 4.

    1 where the field has too few contacts, or no posterior. How strongly the errors of modes are correlated depends on
    what is wrong with a field: a body that is nearly the object's errs in all modes at once, splines between few
    contacts err in each mode by itself. No constant serves both. But every field with a posterior can predict the gains
    at each of its own contacts from those at other places, and their positions are known: the exponent is the one with
    which these positions are most probable (the logarithmic score, which is best for the true probabilities).
    """
    if not can_self_calibrate(field):
        return 1.0
    gains = field.fitted_mixture
    together = gains.places
    contacts = farthest_points(gains.contacts, min(_MAX_HOLDOUT, len(gains.contacts)))
    points = gains.points.double()
    near = torch.from_numpy(cKDTree(points.numpy()).query(gains.contacts[contacts].numpy())[1])
    spread = farthest_points(points, min(_POINTS, len(points)))
    rows = torch.unique(torch.cat([spread, near]))
    truths = torch.searchsorted(rows, near)
    places, factor = gains.points[rows], calibration_factor(field)
    about = local_variance(gains.points, gains.predict(gains.points).mean)[rows]
    prior = point_areas(places).clamp_min(1e-300).log() if len(places) > 2 else torch.zeros(len(places)).double()
    smoothing = smoothing_matrix(places, contacts=distinct_contacts(field))
    # A locator leaves the others out, too.
    kept = torch.nonzero(field.audible & (field.scale != 0.0)).flatten()
    rotated = torch.polar(torch.ones_like(field.phase), field.phase)[kept]
    weights = 1.0 / (4.0 * field.bank.damping[kept].double())
    score = -0.5 * (_FACTORS.log() / _LOG_PRIOR_STD).square()
    for contact, truth in zip(contacts.tolist(), truths.tolist(), strict=True):
        left = gains.without(together == together[contact])
        if left.place_count < 2:
            continue
        measured = gains.values[contact][kept] * rotated
        if not bool(measured.any()):
            continue
        loudest = float(measured.abs().max())
        mean, variance, _ = predict(replace(field, gain_field=left), places, factor=factor)
        # In a unit in which float32 holds all squares, as in a locator.
        mean, variance = mean[:, kept] / loudest, (variance + about)[:, kept] / loudest**2
        known = PredictedGains(mean, variance, field.bank.frequency[kept].double())
        found = Likelihood(known, measured, torch.full(measured.shape, _NOISE * loudest**2, dtype=torch.float64))
        row = int(found.log_likelihood.argmax())
        explained = _explained_energy(known.gains[row].to(measured), measured, weights)
        exponents = _FACTORS.new_tensor([found.tempering(explained, factor=tried) for tried in _FACTORS.tolist()])
        score += _log_score(exponents[:, None] * found.log_likelihood + prior, truth, smoothing)
    return float(_FACTORS[int(score.argmax())])


def _explained_energy(predicted: Tensor, measured: Tensor, weights: Float64[Tensor, " modes"]) -> float:
    """Return the part of the energy of measured gains that predicted ones explain at their best force."""
    own = float((weights * predicted.abs().square()).sum())
    match = float((weights * (measured.conj() * predicted).real).sum())
    whole = float((weights * measured.abs().square()).sum())
    return 0.0 if own == 0.0 else min(1.0, match**2 / own / whole)


def _log_score(
    logs: Float64[Tensor, "tried points"], truth: int, smoothing: csr_array | None
) -> Float64[Tensor, " tried"]:
    """Return the logarithm of the probability of the true point under each of several posteriors."""
    probability = torch.softmax(logs, 1)
    if smoothing is not None:
        probability = torch.from_numpy((smoothing @ probability.numpy().T).T)
    return probability[:, truth].clamp_min(1e-300).log()
