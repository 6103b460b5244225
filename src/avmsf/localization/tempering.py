"""The exponent of the tempered likelihood, calibrated on a field's own contacts, each left out in turn.

How strongly the errors of modes are correlated depends on what is wrong with a field: a body that is nearly the
object's errs in all modes at once, splines between few contacts err in each mode by itself. No constant serves both.
But every field with a posterior can predict the gains at each of its own contacts from the others, and their positions
are known: the exponent is the one with which these positions are most probable (the logarithmic score, which is best
for the true probabilities).
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Float32, Float64, Int64
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.gains.model import MixtureGains
from avmsf.field.sound_field import SoundField
from avmsf.field.uncertainty import fitted_mixture, scale_of
from avmsf.gaussians.points import farthest_points
from avmsf.localization.likelihood import PredictedGains, evaluate_likelihood
from avmsf.localization.prediction import (
    calibration_factor,
    can_self_calibrate,
    distinct_contacts,
    local_variance,
    point_areas,
    predict,
    smoothing_matrix,
)

_MAX_HOLDOUT = 12
"""Contacts that are left out, at most: those farthest apart."""
_POINTS = 300
"""Number of points of the surface at which the likelihood is computed, besides those nearest to the contacts."""
_FACTORS = torch.logspace(-2.0, 0.6, 27, dtype=torch.float64)
_LOG_PRIOR_STD = 1.0
"""Standard deviation of the factor's logarithm without any contact: e times as much or as little."""
_SAME = 1e-6
"""Distance over the object's size within which two contacts are in one place."""
_NOISE = 1e-10
"""Variance of the measured gains' own errors over the strongest one's square: they are taken as they are."""


def calibrate_tempering(field: SoundField) -> float:
    """Return the factor on `likelihood.INDEPENDENT` that a field's own contacts support best, .01 to 4.

    1 where the field has too few contacts, or no posterior.
    """
    if not can_self_calibrate(field):
        return 1.0
    gains = fitted_mixture(field)
    fitted = replace(field, gain_field=gains)
    contacts = _holdout_contacts(gains)
    points = gains.points.double()
    near = torch.from_numpy(cKDTree(points.numpy()).query(gains.contacts[contacts].numpy())[1])
    spread = farthest_points(points, min(_POINTS, len(points)))
    rows = torch.unique(torch.cat([spread, near]))
    truths = torch.searchsorted(rows, near)
    places, factor = gains.points[rows], calibration_factor(fitted)
    about = local_variance(gains.points, lambda some: predict(fitted, gains.points[some])[0], rows)
    prior = point_areas(places).clamp_min(1e-300).log() if len(places) > 2 else torch.zeros(len(places)).double()
    smoothing = smoothing_matrix(places, contacts=distinct_contacts(fitted))
    # A locator leaves the others out, too.
    kept = torch.nonzero(field.audible & (scale_of(field) != 0.0)).flatten()
    rotated = torch.polar(torch.ones_like(field.phase), field.phase)[kept]
    score = -0.5 * (_FACTORS.log() / _LOG_PRIOR_STD).square()
    for contact, truth in zip(contacts.tolist(), truths.tolist(), strict=True):
        left = gains.without(_at_same_point(gains, contact))
        if left.place_count < 2:
            continue
        measured = gains.values[contact][kept] * rotated
        if not bool(measured.any()):
            continue
        loudest = float(measured.abs().max())
        known = _predicted(replace(field, gain_field=left), places, about, kept, factor=factor)
        found = evaluate_likelihood(
            known, measured, torch.full(measured.shape, _NOISE * loudest**2, dtype=torch.float64)
        )
        row = int(found.log_likelihood.argmax())
        explained = _explained_energy(
            known.gains[row].to(measured), measured, 1.0 / (4.0 * field.bank.damping[kept].double())
        )
        exponents = torch.tensor(
            [found.tempering(explained, factor=tried) for tried in _FACTORS.tolist()], dtype=torch.float64
        )
        score += _log_score(exponents[:, None] * found.log_likelihood + prior, truth, smoothing)
    return float(_FACTORS[int(score.argmax())])


def _holdout_contacts(gains: MixtureGains) -> Int64[Tensor, " contacts"]:
    """Return the rows of the contacts that are left out."""
    if len(gains.contacts) <= _MAX_HOLDOUT:
        return torch.arange(len(gains.contacts))
    return farthest_points(gains.contacts, _MAX_HOLDOUT)


def _at_same_point(gains: MixtureGains, contact: int) -> Tensor:
    """Return which contacts are where one is."""
    size = (gains.points.amax(0) - gains.points.amin(0)).double().norm()
    return (gains.contacts - gains.contacts[contact]).norm(dim=1) <= _SAME * size


def _predicted(
    field: SoundField,
    places: Float[Tensor, "points 3"],
    about: Float32[Tensor, "points modes"],
    kept: Int64[Tensor, " kept"],
    *,
    factor: float,
) -> PredictedGains:
    """Return the predicted gains of some modes at places; `about` is their variance around each."""
    predicted, variance, _ = predict(field, places, factor=factor)
    gains = predicted[:, kept]
    power = gains.abs().square()
    mean_power = power.mean(0)
    mean_power = mean_power.clamp_min(max(1e-8 * float(mean_power.max()), torch.finfo(torch.float32).tiny))
    return PredictedGains(gains, power, (variance + about)[:, kept], mean_power, field.bank.frequency[kept].double())


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
