"""Recordings of two levels: those from one on were made with another gain, microphone place or force scale.

Where the recordings from the k-th on are g times too loud, they and the others are predicted from each other once they
are divided by g. Those k and g are tried that most raise the log predictive density of all gains over that without
places (`outliers`): for n contacts, the gains y of one series so divided and P the inverse of their covariance,

    n/2 log(y' y) - n/2 log(y' P y) + constant of y

(Student t, the scale integrated out). Sums of blocks of P y y' give it for all g.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avmsf.field.gains.family import KernelFamily
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.outliers import INFORMATIVE, WIDE_NOISE_SHARES, PredictiveRatios, surely_positive

_FEWEST = 3
"""Recordings of a group: of fewer, each is judged by itself."""
_LEVELS = torch.arange(-40, 41, dtype=torch.float64)
"""dB."""
_LEAST = 3.0
"""dB: less is not told from how hard somebody taps."""
_ROUNDS = 2
"""Of fit and search: gains of two levels look like noise at first."""


def two_levels(
    families: Sequence[KernelFamily],
    measured: MeasuredGains,
    points: Float32[Tensor, "points 3"],
    *,
    directional: bool,
) -> tuple[int, float] | None:
    """Return the first of the last contacts that are surely of another level, and by how many dB they are louder.

    Student's test of the rise of the log predictive ratios over contacts, with Bonferroni's correction for the places
    where a group may begin; and places then have to say enough of the gains. None where levels agree. `families` are of
    the measured contacts, in the order in which they were recorded; `points` are the object's.
    """

    def ratios(values: MeasuredGains) -> PredictiveRatios:
        model = fit_mixture(families, values, points, directional=directional, noise_shares=WIDE_NOISE_SHARES)
        return PredictiveRatios(model, families[0].reference, values)

    count = len(families[0].reference)
    if count < 2 * _FEWEST:
        return None
    given = found = ratios(measured)
    for _ in range(_ROUNDS):
        first, level = _likeliest(found, given.values)
        if abs(level) < _LEAST:
            return None
        values = measured.values.clone()
        values[first:] *= 10 ** (-level / 20)
        found = ratios(replace(measured, values=values))
    explained = found.without(frozenset())[0]
    surely = surely_positive(explained - given.without(frozenset())[0], candidates=count - 2 * _FEWEST + 1)
    return (first, level) if surely and float(explained.mean()) >= INFORMATIVE else None


def _likeliest(hypotheses: PredictiveRatios, values: Float64[Tensor, "contacts series"]) -> tuple[int, float]:
    """Return where the second group most probably begins and its level, dB, by the kernels of some hypotheses."""
    count = len(values)
    factor = 10 ** (-_LEVELS / 20)

    def log_quadratic(precision: Tensor) -> Float64[Tensor, "levels begins series"]:
        products = precision * values.T[:, :, None] * values.T[:, None]
        before = torch.stack([products[:, :row, :row].sum((1, 2)) for row in begins])
        after = torch.stack([products[:, row:, row:].sum((1, 2)) for row in begins])
        across = products.sum((1, 2)) - before - after
        scale = factor[:, None, None]
        return (before + scale * across + scale.square() * after).clamp_min(torch.finfo(torch.float64).tiny).log()

    begins = range(_FEWEST, count - _FEWEST + 1)
    rise = log_quadratic(torch.eye(count, dtype=torch.float64)) - log_quadratic(torch.linalg.inv(hypotheses.covariance))
    level, begin = divmod(int((rise @ hypotheses.weight).argmax()), len(begins))
    return begins[begin], float(_LEVELS[level])
