"""Training contacts whose label (place and direction) contradicts the others, and whether a body is credible.

The log Bayes factor of "places" against "no places", under which gains are independent, is for the values y of the n
contacts of a set, of the evidence of `mixture` and with w_s the share of a series' mode in the energy,

    M = sum_s w_s [n/2 log(y_s' y_s) - n/2 log Q_s - 1/2 log|C_s|],   Q_s = y_s' P_s y_s,   P_s = C_s^-1.

The leave-one-out log predictive ratio of contact i, given contacts S that are set aside, is what i adds to it,

    L_i(S) = M(all but S) - M(all but S and i),

above 0 where the other contacts predict contact i, and below where its gains are less probable there than anywhere.
Without the contacts of a block B, with a = P y (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006,
section 5.4.2, for blocks),

    Q -> Q - a_B' P_BB^-1 a_B,   log|C| -> log|C| + log|P_BB|,

of one contact or of two in closed form.

The contacts S that are set aside maximize

    J(S) = sum over i not in S of min(L_i(S), 3) - .3 |S|,

found by adding, removing or exchanging one contact; the kernels are weighed again without S. A contact of S is an
outlier if its own label is refuted, L_i < -1.5, and if another site or the opposite direction explains it. Where places
say little of the gains nothing is an outlier.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import scipy
import torch
from jaxtyping import Complex128, Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts, places_of
from avmsf.field.gains.fitting import MeasuredGains
from avmsf.field.gains.kernels import KernelFamily, Sites
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import series_of

WIDE_NOISE_SHARES = (*NOISE_SHARES, 0.1, 0.3, 1.0, 3.0)
"""A wrong label may look like noise: the hypotheses that contacts are judged by have to allow for it."""
_INFORMATIVE = 0.7
"""Mean ratio, nats per mode, from which on places say enough to accuse a contact, or to name a body."""
_BODY_GAIN = 0.3
"""Nats per mode that a body has to add. An aircraft's and a ruler's add .7 to 1.7, with shuffled shapes .16 at most."""
_ENOUGH, _COST = 3.0, 0.3
"""Nats above which a contact does not argue for setting others aside, and that a contact set aside costs."""
_MAX_PART = 4
"""One contact in so many may be set aside."""
_MIN_PLACES = 6
"""Of fewer, one is hardly predicted by the others."""
_ROUNDS = 3
"""Of fit and search."""
_MIN_STEP = 1e-9
"""Nats that a step of the search has to add: more than rounding does."""
_REFUTED = -1.5
"""Nats below which a contact's own label is refuted."""
_EXPLAINED = 0.4
"""Part of the others' mean ratio that a contact has to reach at another place."""
_GAINS = tuple(10 ** (db / 20) for db in range(-60, 61))
"""Factors by which one recording may be off: of an amplifier, a scale or a force."""
CHANCE = 0.0228
"""Probability that errors fall as much by chance: that of two standard errors of a normal distribution."""
_TINY = torch.finfo(torch.float64).tiny

Fit = Callable[[Int[Tensor, " rows"], tuple[float, ...]], MixtureGains]
"""Fits the gain model to some of the contacts with these noise shares."""


@dataclass(frozen=True, eq=False)
class PredictiveRatios:
    """Log predictive ratios of contacts under one hypothesis for each series, its most probable one."""

    model: MixtureGains
    """Fitted to some of the contacts; gives the hypotheses."""
    sites: Sites
    """All contacts."""
    measured: MeasuredGains
    """Gains at all contacts."""
    aside: frozenset[int] = frozenset()
    """Contacts that are set aside."""

    def mean(self) -> float:
        """Return the mean ratio of the contacts that are not set aside, of repeated recordings the first one alone.

        These predict each other, whatever a body says.
        """
        rows = others(self.sites, self.aside)
        first = rows[torch.unique(self.sites.take(rows).repetitions())]
        return float(self.without(frozenset(range(len(self.sites))) - {*first.tolist()})[0].nanmean())

    @cached_property
    def values(self) -> Float64[Tensor, "contacts series"]:
        """Both parts of the gains."""
        return series_of(self.measured.values)

    @cached_property
    def weight(self) -> Float64[Tensor, " series"]:
        """Each mode's share of the energy, for both its parts."""
        return (self.measured.energy / self.measured.energy.sum().clamp_min(_TINY)).repeat(2)

    @cached_property
    def covariance(self) -> Float64[Tensor, "series contacts contacts"]:
        """C of each series between all contacts, noise included."""
        kernels = self._each(lambda family: family.between(self.sites, self.sites))
        return kernels + self._noise[:, None, None] * torch.eye(len(self.sites), dtype=torch.float64)

    def without(
        self, aside: frozenset[int]
    ) -> tuple[Float64[Tensor, " contacts"], Float64[Tensor, "contacts contacts"]]:
        """Return L_i(S), and L_i(S and j) [i, j]; NaN for contacts in S and for i = j."""
        rows = others(self.sites, aside)
        values, inverse, solved, quadratic = self._solved(rows)
        own, squares, count = torch.diagonal(inverse, dim1=1, dim2=2), values.square(), len(rows)
        power, scaled = squares.sum(1, keepdim=True), solved / own
        one = quadratic[:, None] - solved * scaled
        shared = own[:, :, None] - inverse.square() / own[:, None]
        two = one[:, None] - (solved[:, :, None] - inverse * scaled[:, None]).square() / shared
        both = power[:, None] - squares[:, :, None] - squares[:, None]
        whole = self._log_density(count, quadratic[:, None]) - self._log_density(count, power)
        less = self._log_density(count - 1, one, own) - self._log_density(count - 1, power - squares)
        least = self._log_density(count - 2, two, shared * own[:, None]) - self._log_density(count - 2, both)
        single, pairs = torch.full((2, len(self.sites), len(self.sites)), torch.nan, dtype=torch.float64)
        single[rows, 0] = whole - less
        pairs[rows[:, None], rows] = (less - least).fill_diagonal_(torch.nan)
        return single[:, 0], pairs

    def _log_density(self, count: int, quadratic: Tensor, factor: Tensor | None = None) -> Tensor:
        """Return the weighted log evidence of `count` contacts; `factor` is their |C| over that of all contacts."""
        logs = count * quadratic.clamp_min(_TINY).log()
        if factor is not None:
            logs = logs + factor.clamp_min(_TINY).log()
        return torch.tensordot(self.weight, -0.5 * logs, dims=1)

    def elsewhere(
        self, row: int, aside: frozenset[int], places: Sites, factors: Sequence[float] = (1.0, -1.0)
    ) -> Float64[Tensor, "factors places"]:
        """Return the ratio of a contact if it had another site, and its recording were what is true times a factor.

        A factor of -1 is the opposite direction. Without places the recording has the best of the factors, too.
        """
        rows = others(self.sites, aside | {row})
        values, inverse, solved, quadratic = self._solved(rows)
        known, gain = self.sites.take(rows), self.values[row][:, None]
        cross = self._each(lambda family: family.between(places, known))
        mean, count = (cross @ solved[..., None])[..., 0], len(rows)
        own = self._each(lambda family: family.own(places)) + self._noise[:, None]
        variance = own - ((cross @ inverse) * cross).sum(2)
        power = values.square().sum(1, keepdim=True)
        before, unplaced = (self._log_density(count, each) for each in (quadratic[:, None], power))
        found, nowhere = [], []
        for factor in factors:
            scaled, jacobian = gain / factor, self.weight.sum() * math.log(abs(factor))
            whole = quadratic[:, None] + (scaled - mean).square() / variance
            found.append(self._log_density(count + 1, whole, variance) - before - jacobian)
            nowhere.append(self._log_density(count + 1, power + scaled.square()) - unplaced - jacobian)
        return torch.stack(found) - torch.stack(nowhere).amax(0)

    def _solved(self, rows: Int[Tensor, " rows"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return y [series, rows], P [series, rows, rows], P y [series, rows] and y' P y [series] of some contacts."""
        values = self.values[rows].T
        inverse = torch.linalg.inv(self.covariance[:, rows[:, None], rows])
        solved = (inverse @ values[..., None])[..., 0]
        return values, inverse, solved, (solved * values).sum(1)

    @cached_property
    def _best(self) -> Int[Tensor, " series"]:
        return self.model.mixture.weights.flatten(0, 1).argmax(0)

    @cached_property
    def _noise(self) -> Float64[Tensor, " series"]:
        variance = self.model.mixture.noise_variance
        return variance.gather(0, (self._best % len(variance))[None])[0]

    def _each(self, kernels: Callable[[KernelFamily], Tensor]) -> Tensor:
        """Return what each series's most probable kernel gives."""
        used, series = torch.unique(self._best // len(self.model.mixture.noise_shares), return_inverse=True)
        return torch.cat([kernels(each) for each in self.model.families_of(used)])[series]


@dataclass(frozen=True)
class Credibility:
    """How well contacts are predicted from each other, with the body behind the surface and without."""

    with_body: float
    """Mean log predictive ratio over the contacts that are not set aside, nats per mode."""
    without_body: float

    @property
    def gained(self) -> float:
        """What the body adds."""
        return self.with_body - self.without_body

    @property
    def credible(self) -> bool:
        """Whether a body may be named: its mode shapes predict what the distances between contacts do not."""
        return self.with_body >= _INFORMATIVE and self.gained >= _BODY_GAIN


@dataclass(frozen=True)
class Outlier:
    """A contact that the others contradict, and where on the object it would agree with them."""

    row: int
    """Among the training contacts."""
    ratio: float
    """Log predictive ratio, nats per mode: below zero the place predicts its gains worse than no place does."""
    place: tuple[float, float, float]
    """Where it is explained best, object frame, meters."""
    distance: float
    """From its own place, meters."""
    reversed: bool
    """Whether the opposite direction explains it at its own place."""
    level_db: float = 0.0
    """By how much its level is too high at its own place, where that explains it better than any place does."""

    def describe(self, train: Impacts, *, with_body: bool) -> str:
        """Return its possible causes in words, the most frequent first, of all recordings and judged with a body."""
        directed = train.directions is not None and bool(train.directions[self.row].any())
        causes = [] if directed else ["no direction, at an edge or a handle (give nx,ny,nz)"]
        apart = (train.contacts.double() - torch.tensor(self.place, dtype=torch.float64)).norm(dim=1)
        own, apart[self.row] = float(apart[self.row]), torch.inf
        other = int(apart.argmin())
        if self.level_db:
            sign = "higher" if self.level_db > 0 else "lower"
            causes.append(f"a gain {abs(self.level_db):.0f} dB {sign} than the others'")
        elif float(apart[other]) < own:
            causes.append(f"its label was exchanged with that of {train.names[other]}")
        if self.reversed:
            causes.append("a reversed direction or polarity" if directed else "a reversed polarity")
        elif directed and self.distance == 0.0 and not self.level_db:
            causes.append("a wrong direction")
        if self.distance > 0.0 and not self.level_db:
            causes.append("a wrong position")
        if with_body:
            causes.append("a body that does not fit")
        return f"{train.names[self.row]} contradicts the other recordings; possible causes: {', '.join(causes)}"


def assess_contacts(
    plain: Fit, elastic: Fit | None, sites: Sites, places: Sites, measured: MeasuredGains
) -> tuple[list[Outlier], Credibility | None]:
    """Return the contacts that the others contradict, the surest first, and how credible a body is.

    `plain` fits the gain model without elastic families, `elastic` with them, where there is a body. Contacts are
    judged without the body unless it is credible. `sites` are all contacts, `places` impacts all over the object.
    """
    credibility = None
    if elastic is not None:
        used = _search(elastic, sites, measured)
        model = plain(others(sites, used.aside), WIDE_NOISE_SHARES)
        credibility = Credibility(used.mean(), replace(used, model=model).mean())
    if credibility is None or not credibility.credible:
        used = _search(plain, sites, measured)
    mean = used.mean()
    located = [_located(used, row, places, mean) for row in sorted(used.aside)] if mean >= _INFORMATIVE else []
    return sorted(filter(None, located), key=lambda each: each.ratio), credibility


def set_aside(ratios: PredictiveRatios, start: frozenset[int] = frozenset()) -> frozenset[int]:
    """Return the best set that adding, removing or exchanging one contact leads to, of a quarter of them at most."""
    most, current = len(ratios.sites) // _MAX_PART, start
    score = float(_score(ratios.without(current)[0], len(current)))
    while True:
        tried: list[tuple[float, frozenset[int]]] = []
        for base in (current, *(current - {row} for row in sorted(current))):
            single, pairs = ratios.without(base)
            tried.append((float(_score(single, len(base))), base))
            if len(base) < most:
                more = torch.where(torch.isnan(single), -torch.inf, _score(pairs, len(base) + 1))
                tried.append((float(more.max()), base | {int(more.argmax())}))
        best, found = max(tried, key=lambda each: each[0])
        if best <= score + _MIN_STEP:
            return current
        score, current = best, found


def predicts_better(
    new: Complex128[Tensor, "contacts modes"], old: Complex128[Tensor, "contacts modes"], measured: MeasuredGains
) -> bool:
    """Return whether gains are surely predicted better, from leave-one-place-out predictions at the same contacts.

    The errors over measured and predicted gains, each mode by its energy, have to fall more than by chance: Wilcoxon's
    signed-rank test of the paired differences. Over the measured ones alone, a contact near a support would outweigh
    all others, as it would in a test of the mean.
    """

    def energy(values: Complex128[Tensor, "contacts modes"]) -> Float64[Tensor, " contacts"]:
        return (values.abs().square() / measured.damping).sum(1)

    power = energy(measured.values)
    less, more = ((energy(each - measured.values) / (power + energy(each))).sqrt() for each in (new, old))
    fall = (more - less)[power > 0].numpy()
    return bool(fall.any()) and float(scipy.stats.wilcoxon(fall, alternative="greater").pvalue) < CHANCE


def _search(fit: Fit, sites: Sites, measured: MeasuredGains) -> PredictiveRatios:
    """Return the ratios with the contacts to set aside, the kernels weighed without those of the round before."""
    aside: frozenset[int] = frozenset()
    enough = len(torch.unique(places_of(sites.points))) >= _MIN_PLACES
    for _ in range(_ROUNDS):
        ratios = PredictiveRatios(fit(others(sites, aside), WIDE_NOISE_SHARES), sites, measured)
        before, aside = aside, set_aside(ratios, aside) if enough else aside
        if aside == before:
            break
    return replace(ratios, aside=aside)


def _located(search: PredictiveRatios, row: int, places: Sites, mean: float) -> Outlier | None:
    """Return a contact as an outlier if it is one by the standard of the others' mean ratio."""
    contacts = search.sites
    everywhere = Sites.joined([contacts, places])
    ratios = search.elsewhere(row, search.aside, everywhere)
    own, best = float(ratios[0, row]), int(ratios.amax(0).argmax())
    ratio, needed = float(ratios[:, best].max()), _EXPLAINED * mean
    here = search.elsewhere(row, search.aside, contacts.take(torch.tensor([row])), _GAINS)[:, 0]
    level_db, leveled = 20 * math.log10(_GAINS[int(here.argmax())]), float(here.max())
    # Both over the probability without places of the gain as it is.
    better = leveled >= needed and leveled + own - float(here[_GAINS.index(1.0)]) > ratio
    if own >= _REFUTED or (ratio < needed and not better):
        return None
    best = row if better else best
    x, y, z = everywhere.points[best].tolist()
    distance = float((everywhere.points[best] - contacts.points[row]).norm())
    return Outlier(row, own, (x, y, z), distance, float(ratios[1, row]) >= needed, level_db if better else 0.0)


def others(sites: Sites, aside: Collection[int]) -> Int[Tensor, " rows"]:
    """Return the rows of the contacts that are not set aside."""
    return torch.tensor([row for row in range(len(sites)) if row not in aside])


def _score(ratios: Float64[Tensor, "contacts *sets"], count: int) -> Float64[Tensor, "*sets"]:
    """Return J of sets of this size."""
    return ratios.clamp_max(_ENOUGH).nansum(0) - _COST * count
