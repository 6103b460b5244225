"""The tempering factor of a field's likelihoods, calibrated on its own impacts, each left out in turn.

How far the errors of modes hang together depends on what is wrong with a field: a body that is nearly the object's errs
in all modes at once, splines between few contacts err in each mode by itself. No constant serves both. But every field
that knows its doubt can predict each of its own strikes from the others, and their places are known: so much is made
of the likelihood that these places are as probable as they can be (the logarithmic score, which is best for the
probabilities that are true).
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Float32, Float64, Int64
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.gains.model import MixtureGains
from avmsf.field.soundfield import SoundField
from avmsf.field.uncertainty import fitted_mixture, scale_of
from avmsf.scene.points import farthest_points
from avmsf.tasks.posterior import PredictedGains, judge
from avmsf.tasks.prediction import judges_itself, patches, predict, unknown, widened
from avmsf.tasks.smoothing import areas_of, contacts_of, smoothing_kernel

_STRIKES = 12
"""Strikes that are left out, at most: those farthest apart."""
_POINTS = 300
"""Points of the surface that these are looked for at, beside their own."""
_TRIED = torch.logspace(-2.0, 0.6, 27, dtype=torch.float64)
_BEFOREHAND = 1.0
"""Standard deviation of the factor's logarithm before any strike is asked: e times as much or as little."""
_SAME = 1e-6
"""Distance over the object's size within which two strikes are in one place."""
_NOISE = 1e-10
"""Variance of the measured gains' own errors over the strongest one's square: they are taken as they are."""


def calibrate_tempering(field: SoundField) -> float:
    """Return the factor on `posterior.INDEPENDENT` that a field's own strikes bear out best, .01 to 4.

    1 where the field has too few strikes to tell, or does not know how sure it is.
    """
    if not judges_itself(field):
        return 1.0
    gains = fitted_mixture(field)
    fitted = replace(field, gain_field=gains)
    strikes = _strikes(gains)
    points = gains.points.double()
    near = torch.from_numpy(cKDTree(points.numpy()).query(gains.contacts[strikes].numpy())[1])
    spread = farthest_points(points, min(_POINTS, len(points)))
    rows = torch.unique(torch.cat([spread, near]))
    truths = torch.searchsorted(rows, near)
    places, factor = gains.points[rows], widened(fitted)
    about = patches(gains.points, predict(fitted, gains.points, None)[0])[rows]
    prior = areas_of(places).clamp_min(1e-300).log() if len(places) > 2 else torch.zeros(len(places)).double()
    kernel = smoothing_kernel(places, contacts=contacts_of(fitted))
    # A locator does not hear the others either.
    kept = torch.nonzero(field.audible & (scale_of(field) != 0.0)).flatten()
    turned = torch.polar(torch.ones_like(field.phase), field.phase)[kept]
    score = -0.5 * (_TRIED.log() / _BEFOREHAND).square()
    for strike, truth in zip(strikes.tolist(), truths.tolist(), strict=True):
        left = gains.without(_same_place(gains, strike))
        if left.place_count < 2:
            continue
        heard = gains.values[strike][kept] * turned
        if not bool(heard.any()):
            continue
        loudest = float(heard.abs().max())
        known = _foretold(replace(field, gain_field=left), places, about, kept, factor=factor)
        found = judge(known, heard, torch.full(heard.shape, _NOISE * loudest**2, dtype=torch.float64))
        row = int(found.log_likelihood.argmax())
        explained = _explained(known.gains[row].to(heard), heard, 1.0 / (4.0 * field.bank.damping[kept].double()))
        trusts = torch.tensor(
            [found.tempering(explained, factor=tried) for tried in _TRIED.tolist()], dtype=torch.float64
        )
        score += _log_score(trusts[:, None] * found.log_likelihood + prior, truth, kernel)
    return float(_TRIED[int(score.argmax())])


def _strikes(gains: MixtureGains) -> Int64[Tensor, " strikes"]:
    """Return the rows of the contacts that are left out."""
    if len(gains.contacts) <= _STRIKES:
        return torch.arange(len(gains.contacts))
    return farthest_points(gains.contacts, _STRIKES)


def _same_place(gains: MixtureGains, strike: int) -> Tensor:
    """Return which contacts are where one is."""
    size = (gains.points.amax(0) - gains.points.amin(0)).double().norm()
    return (gains.contacts - gains.contacts[strike]).norm(dim=1) <= _SAME * size


def _foretold(
    field: SoundField,
    places: Float[Tensor, "points 3"],
    about: Float32[Tensor, "points modes"],
    kept: Int64[Tensor, " kept"],
    *,
    factor: float,
) -> PredictedGains:
    """Return what a field foretells of some modes at places whose gains vary by `about` around them."""
    gains = predict(field, places, None)[0][:, kept]
    power = gains.abs().square()
    usual = power.mean(0)
    usual = usual.clamp_min(max(1e-8 * float(usual.max()), torch.finfo(torch.float32).tiny))
    variance = (unknown(field, places, None, factor=factor) + about)[:, kept]
    return PredictedGains(gains, power, variance, usual, field.bank.frequency[kept].double())


def _explained(predicted: Tensor, heard: Tensor, weights: Float64[Tensor, " modes"]) -> float:
    """Return the part of the energy of what was heard that gains explain at their best force."""
    own = float((weights * predicted.abs().square()).sum())
    match = float((weights * (heard.conj() * predicted).real).sum())
    whole = float((weights * heard.abs().square()).sum())
    return 0.0 if own == 0.0 else min(1.0, match**2 / own / whole)


def _log_score(
    logs: Float64[Tensor, "tried points"], truth: int, kernel: csr_array | None
) -> Float64[Tensor, " tried"]:
    """Return the logarithm of the probability of the true point under each of several posteriors."""
    probability = torch.softmax(logs, 1)
    if kernel is not None:
        probability = torch.from_numpy((kernel @ probability.numpy().T).T)
    return probability[:, truth].clamp_min(1e-300).log()
