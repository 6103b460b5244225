"""Labels of all recordings at once: another order, or two levels, where places say nothing of the gains.

Of the `candidate_orders` the one of the highest evidence is named if it makes the sum of all log predictive ratios
(`outliers`) surely higher.

Recordings from one on may have been made with another gain, microphone place or force scale. Where those from the k-th
on are g times too loud, the gains y of a series of n contacts are D z, D being diagonal with 1 before the k-th contact
and g from it on, and z gains as the kernels describe them. So

    log p(y | k, g) = log p_z(D^-1 y) - (n - k) log g

with the evidence of kernel families for p_z. Smooth families without a body are enough: a step of the level is seen in
contacts near each other. All series have k and g in common. It explains only what nothing else does: contacts in the
order of their places, as a roving hammer's, may be weaker from one on since the object is stiffer there.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import scipy
import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf._utils.text import counted
from avmsf.capture.filenames import number_key
from avmsf.capture.settings import TABLE
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, fit_mixture, total_evidence
from avmsf.field.gains.kernels import KernelFamily
from avmsf.field.gains.outliers import CHANCE, WIDE_NOISE_SHARES, PredictiveRatios

_MIN_GROUP = 3
"""Recordings of a group: of fewer, each is judged by itself."""
_COARSE_DB = (-30.0, -24.0, -18.0, -12.0, -6.0, 6.0, 12.0, 18.0, 24.0, 30.0)
_FINE_DB = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Levels tried, dB, and those about the best of them."""
_SURE = 0.5
"""Nats for each series by which the evidence has to rise, beside the logarithm of how many steps are tried."""
_SHIFTS = 5
"""Rows by which recordings may be off: takes left out or repeated before the first."""
_SHOWN = 4
"""Changes that a message lists, at most."""


def candidate_orders(names: Sequence[str]) -> dict[str, Int[Tensor, " rows"]]:
    """Return orders in which the recordings of these names may belong to the rows of a table, and what they are.

    Sorted by the numbers in their names or as text, all reversed, or all moved by some rows; only such as differ from
    the present one and from each other. Row r has the recording `order[r]`.
    """
    rows = list(range(len(names)))
    found = {
        "the files sorted by number (1, 2, 10)": sorted(rows, key=lambda row: number_key(names[row])),
        "the files sorted as text (1, 10, 2)": sorted(rows, key=names.__getitem__),
        "the files in reverse order": rows[::-1],
    }
    for by in rows[1 : _SHIFTS + 1]:
        found[f"each file {counted(by, 'row')} earlier"] = rows[by:] + rows[:by]
        found[f"each file {counted(by, 'row')} later"] = rows[-by:] + rows[:-by]
    distinct = {tuple(order): words for words, order in reversed(found.items()) if order != rows}
    return {words: torch.tensor(order) for order, words in reversed(distinct.items())}


def order_advice(
    names: Sequence[str],
    families: Sequence[KernelFamily],
    rows: Int[Tensor, " rows"],
    measured: MeasuredGains,
) -> str | None:
    """Return the changes of the table after which the recordings surely agree better with the contacts; None for none.

    Student's test of the log predictive ratios' differences over contacts, with Bonferroni's correction. `families` are
    of the contacts `rows`; `names` and `measured` are all recordings'.
    """

    def ratios(order: Int[Tensor, " contacts"]) -> Float64[Tensor, " rows"]:
        moved, sites = measured.take(order[rows]), families[0].reference
        model = fit_mixture(families, moved, sites.points.float(), directional=True, noise_shares=WIDE_NOISE_SHARES)
        return PredictiveRatios(model, sites, moved).without(frozenset())[0]

    orders = candidate_orders(names)
    best = max(orders, key=lambda words: _evidence(families, measured.take(orders[words][rows])), default=None)
    if best is None:
        return None
    more = ratios(orders[best]) - ratios(torch.arange(len(names)))
    mean, error = float(more.mean()), float(more.std()) / math.sqrt(len(more))
    chance = float(scipy.special.stdtr(len(more) - 1, -mean / max(error, torch.finfo(torch.float64).tiny)))
    if chance >= CHANCE / len(orders):
        return None
    changed = [f"{names[new]} for {names[row]}" for row, new in enumerate(orders[best].tolist()) if new != row]
    return (
        f"the recordings do not agree with the contacts, but would far better in another order, {best}: in "
        f"{TABLE} write {', '.join(changed[:_SHOWN])}{', ...' * (len(changed) > _SHOWN)} and fit again"
    )


def level_advice(names: Sequence[str], families: Sequence[KernelFamily], measured: MeasuredGains) -> str | None:
    """Return from which recording on the level is another, by how much, and what to do.

    None where one level explains the gains about as well. `names` and `families` are those of the measured contacts, in
    the order in which they were recorded.
    """
    count, series = len(measured.values), float(measured.informative.sum())

    def evidence(first: int, level: float) -> float:
        values = measured.values.clone()
        values[first:] *= 10 ** (-level / 20)
        jacobian = series * (count - first) * level / 20 * math.log(10)
        return _evidence(families, replace(measured, values=values)) - jacobian

    steps = product(range(_MIN_GROUP, count - _MIN_GROUP + 1), _COARSE_DB)
    tried = {step: evidence(*step) for step in steps}
    if not tried:
        return None
    first, level = max(tried, key=tried.__getitem__)
    near = {(first, float(level + more)): evidence(first, level + more) for more in _FINE_DB}
    best = max(near, key=near.__getitem__)
    if near[best] - evidence(0, 0.0) <= _SURE * series + math.log(len(tried)):
        return None
    first, level = best
    return (
        f"the recordings from {names[first]} on are {abs(level):.0f} dB {'louder' if level > 0 else 'weaker'} than "
        "expected from those before, as if the gain, the microphone's place or the force's scale had changed: bring "
        "all to one level, or fit each group by itself"
    )


def _evidence(families: Sequence[KernelFamily], measured: MeasuredGains) -> float:
    return total_evidence([WeighedFamily.of(each, measured) for each in families], measured)
