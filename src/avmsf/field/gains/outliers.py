"""Training contacts whose label (place and direction) contradicts the others, and whether a body is to be believed.

For contact i, given contacts S that are set aside, the leave-one-out log predictive ratio is

    L_i(S) = sum_s w_s [log p(y_is | y_Rs, places) - log p(y_is | y_Rs, no places)],   R = all contacts but S and i,

over all series s (each part of each mode's gains), w_s being the mode's share of the energy. Both densities are Student t
with as many degrees of freedom as R has contacts, the scale integrated out (`mixture`); without places gains are
independent of each other. So L_i > 0 where the other contacts' gains and places predict contact i, and L_i < 0 where
its gains are less probable there than anywhere. In closed form, with P = C^-1 of R and i, a = P y and Q = y' a,

    log p(y_i | y_R) = -n/2 log Q + (n-1)/2 log(Q - a_i^2 / P_ii) + 1/2 log P_ii + constant of n

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2), and without j as well

    P_ii -> P_ii - P_ij^2 / P_jj,   a_i -> a_i - P_ij a_j / P_jj,   Q -> Q - a_j^2 / P_jj.

Standardized leave-one-out errors do not serve: those of the kernels' misfit are as large as a wrong label's, while the
ratio to gains without places measures both on one scale.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.field.gains.family import KernelFamily, Sites
from avmsf.field.gains.fitting import MeasuredGains
from avmsf.field.gains.mixture import NOISE_SHARES
from avmsf.field.gains.model import MixtureGains, places_of, series_of

WIDE_NOISE_SHARES = (*NOISE_SHARES, 0.1, 0.3, 1.0, 3.0)
"""A wrong label may look like noise: the hypotheses that contacts are judged by have to allow for it."""
INFORMATIVE = 0.7
"""Mean ratio, nats per mode, from which on places say enough to accuse a contact, or to name a body."""
_BODY_GAIN = 0.3
"""Nats per mode that a body has to add; shuffled mode shapes add .08 at most."""
_ENOUGH = 3.0
"""Nats above which a contact does not argue for setting others aside."""
_COST = -0.3
"""Nats that a contact set aside counts."""
_MOST = 4
"""One contact in so many may be set aside."""
_ROUNDS = 3
"""Of search and fit."""
_LEAST_PLACES = 6
_REFUTED = -0.5
"""Nats below which the place is worse than none."""
_BETTER, _BETTER_SHARE = 1.5, 0.3
"""Nats that another place has to add, and the part of the others' mean that it has to reach."""
_LEAST_STEP = 1e-9
"""Nats that a step of the search has to add."""
_SURE = 2.0
"""Standard errors by which the others' errors have to fall."""
_TINY = torch.finfo(torch.float64).tiny

Fit = Callable[[Int[Tensor, " rows"], tuple[float, ...]], MixtureGains]
"""Fits the gain model to some of the contacts, with these noise shares; families are those of these contacts."""


@dataclass(frozen=True)
class Credibility:
    """How well the gain model predicts contacts from each other, with the bodies behind the surface and without."""

    with_body: float
    """Mean log predictive ratio over the contacts, nats per mode."""
    without_body: float

    @property
    def credible(self) -> bool:
        """Whether a body may be named: its mode shapes tell what the distances between contacts do not."""
        return self.with_body >= INFORMATIVE and self.with_body - self.without_body >= _BODY_GAIN


@dataclass(frozen=True)
class Outlier:
    """A contact that the others contradict, and where on the object it would agree with them."""

    row: int
    """Among the training contacts."""
    ratio: float
    """Log predictive ratio, nats per mode: below zero the place predicts its gains worse than no place does."""
    place: tuple[float, float, float]
    """Where it is explained best, object frame, metres."""
    place_ratio: float
    """The ratio there."""
    distance: float
    """From its own place, metres."""
    reversed: bool
    """Whether the opposite direction explains it at its own place."""

    def describe(self, names: Sequence[str], contacts: Float[Tensor, "contacts 3"]) -> str:
        """Return what is wrong with it in words, from the names and places (metres) of all training contacts."""
        ratios = (
            f"log predictive ratio {self.ratio:.2g} nats, there {self.place_ratio:.2g}; above 0 the place is plausible"
        )
        if self.distance == 0.0:
            return f"{names[self.row]} fits its place if its direction is reversed ({ratios})"
        place = torch.tensor(self.place, dtype=torch.float64)
        apart = (contacts.double() - place).norm(dim=1)
        own, apart[self.row] = float(apart[self.row]), torch.inf
        other = int(apart.argmin())
        where = ", ".join(f"{each + 0.0:.4g}" for each in self.place)
        found = f"{names[self.row]} does not fit its place; it fits ({where}) m, {self.distance:.2g} m away"
        if float(apart[other]) < own:
            found += f", nearest to {names[other]}: their labels may have been exchanged"
        if self.reversed:
            found += "; or its direction is reversed"
        return f"{found} ({ratios})"


@dataclass(frozen=True, eq=False)
class PredictiveRatios:
    """Log predictive ratios of contacts under one hypothesis for each series, its most probable one."""

    model: MixtureGains
    """Fitted to some of the contacts; gives the hypotheses."""
    sites: Sites
    """All contacts."""
    measured: MeasuredGains
    """Gains at all contacts."""

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
        noise = self._noise[:, None, None] * torch.eye(len(self.sites), dtype=torch.float64)
        return self._kernels(self.sites, self.sites) + noise

    def at(self, aside: frozenset[int] = frozenset()) -> Float64[Tensor, " contacts"]:
        """Return L_i(S) of all contacts, S being `aside` without i itself."""
        found = self.without(aside)[0]
        for row in aside:
            found[row] = self.without(aside - {row})[0][row]
        return found

    def without(
        self, aside: frozenset[int]
    ) -> tuple[Float64[Tensor, " contacts"], Float64[Tensor, "contacts contacts"]]:
        """Return L_i(S), and L_i(S and j) [i, j]; NaN for contacts in S and for i = j."""
        rows = self._rest(aside)
        values, inverse, solved, quadratic = self._solved(rows)
        own, power = torch.diagonal(inverse, dim1=1, dim2=2), values.square().sum(1)
        known = _log_student(solved / own, 1.0 / own, quadratic[:, None], len(rows))
        single = self.weight @ (known - _log_student(values, torch.ones(()), power[:, None], len(rows)))
        shared = inverse / own[:, None]
        variance = 1.0 / (own[..., None] - shared * inverse).clamp_min(_TINY)
        error = (solved[..., None] - shared * solved[:, None]) * variance
        known = _log_student(error, variance, (quadratic[:, None] - solved.square() / own)[:, None], len(rows) - 1)
        less = (power[:, None] - values.square())[:, None]
        unknown = _log_student(values[..., None], torch.ones(()), less, len(rows) - 1)
        pairs = torch.einsum("s,scd->cd", self.weight, known - unknown).fill_diagonal_(torch.nan)
        found = torch.full((len(self.values), len(self.values) + 1), torch.nan, dtype=torch.float64)
        found[rows, -1] = single
        found[rows[:, None], rows] = pairs
        return found[:, -1], found[:, :-1]

    def elsewhere(self, row: int, aside: frozenset[int], places: Sites) -> Float64[Tensor, "2 places"]:
        """Return the ratio of a contact if it had another site, and if it had the opposite direction there."""
        rows = self._rest(aside | {row})
        values, inverse, solved, quadratic = self._solved(rows)
        cross, gain = self._kernels(places, self.sites.take(rows)), self.values[row][:, None]
        mean = (cross @ solved[..., None])[..., 0]
        variance = self._own(places) + self._noise[:, None] - ((cross @ inverse) * cross).sum(2)
        power = values.square().sum(1, keepdim=True)
        nowhere = _log_student(gain, torch.ones(()), power + gain.square(), len(rows) + 1)
        found = []
        for error in (gain - mean, gain + mean):
            whole = quadratic[:, None] + error.square() / variance
            found.append(self.weight @ (_log_student(error, variance, whole, len(rows) + 1) - nowhere))
        return torch.stack(found)

    def _rest(self, aside: frozenset[int]) -> Int[Tensor, " rows"]:
        return torch.tensor([row for row in range(len(self.sites)) if row not in aside])

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

    def _kernels(self, sites: Sites, others: Sites) -> Float64[Tensor, "series sites others"]:
        return self._each(lambda family, rows: family.between(sites, others, rows))

    def _own(self, sites: Sites) -> Float64[Tensor, "series sites"]:
        return self._each(lambda family, rows: family.own(sites, rows))

    def _each(self, kernels: Callable[[KernelFamily, Int[Tensor, " rows"]], Tensor]) -> Tensor:
        """Return what each series's most probable kernel gives."""
        used, series = torch.unique(self._best // len(self.model.mixture.noise_shares), return_inverse=True)
        found, first = [], 0
        for family, kept in zip(self.model.families, self.model.kept, strict=True):
            own = used[(used >= first) & (used < first + len(kept))] - first
            first += len(kept)
            if len(own):
                found.append(kernels(family, kept[own]))
        return torch.cat(found)[series]


def judge_body(with_body: MixtureGains, without: MixtureGains, sites: Sites, measured: MeasuredGains) -> Credibility:
    """Return how well contacts are predicted with bodies and without, by models fitted with `WIDE_NOISE_SHARES`."""
    both = [float(PredictiveRatios(model, sites, measured).at().mean()) for model in (with_body, without)]
    return Credibility(*both)


def find_outliers(fit: Fit, sites: Sites, places: Sites, measured: MeasuredGains) -> tuple[Outlier, ...]:
    """Return the contacts that the others contradict and that another place explains, the lowest ratio first.

    `places` are impacts all over the object; those of the other contacts are tried as well.

    The contacts S set aside maximize the sum over the others of min(L_i(S), 3) - .3 |S|. Where places say little of the
    gains nothing is found, and with fewer than six places neither.
    """
    if len(torch.unique(places_of(sites.points))) < _LEAST_PLACES:
        return ()
    aside: frozenset[int] = frozenset()
    for _ in range(_ROUNDS):
        rest = torch.tensor([row for row in range(len(sites)) if row not in aside])
        ratios = PredictiveRatios(fit(rest, WIDE_NOISE_SHARES), sites, measured)
        before, aside = aside, set_aside(ratios, aside)
        if aside == before:
            break
    known = ratios.at(aside)
    mean = float(known[[row for row in range(len(sites)) if row not in aside]].mean())
    if mean < INFORMATIVE:
        return ()
    found = [_located(ratios, row, aside, places, mean) for row in sorted(aside) if float(known[row]) < _REFUTED]
    return tuple(sorted((each for each in found if each is not None), key=lambda each: each.ratio))


def set_aside(ratios: PredictiveRatios, start: frozenset[int] = frozenset()) -> frozenset[int]:
    """Return the best set that adding, removing or exchanging one contact leads to, of a quarter of them at most."""
    most, current = len(ratios.sites) // _MOST, start
    score = _score(ratios.without(current)[0], len(current))
    while True:
        tried: list[tuple[float, frozenset[int]]] = []
        for base in (current, *(current - {row} for row in sorted(current))):
            single, pairs = ratios.without(base)
            tried.append((float(_score(single, len(base))), base))
            if len(base) < most:
                more = _score(pairs, len(base) + 1)
                more[torch.isnan(single)] = -torch.inf
                tried.append((float(more.max()), base | {int(more.argmax())}))
        best, found = max(tried, key=lambda each: each[0])
        if best <= score + _LEAST_STEP:
            return current
        score, current = best, found


def _score(ratios: Float64[Tensor, "contacts *sets"], count: int) -> Float64[Tensor, "*sets"]:
    return ratios.clamp_max(_ENOUGH).nansum(0) + _COST * count


def excluded(kept: MixtureGains, whole: MixtureGains, rows: Int[Tensor, " kept"], measured: MeasuredGains) -> bool:
    """Return whether the model without some contacts predicts the others from each other surely better than with them.

    `kept` is fitted to the contacts `rows` alone, `whole` to all. The leave-one-place-out errors, over the gains, each
    mode by its energy, have to fall by two standard errors of the paired differences.
    """
    damping, values = measured.damping, measured.values[rows]
    energy = (values.abs().square() / damping).sum(1).clamp_min(_TINY)
    less, more = (
        ((predicted - values).abs().square() / damping).sum(1).div(energy).sqrt()
        for predicted in (kept.leave_one_out(), whole.leave_one_out()[rows])
    )
    fall = more - less
    return float(fall.mean()) > _SURE * float(fall.std()) / len(rows) ** 0.5


def _located(ratios: PredictiveRatios, row: int, aside: frozenset[int], places: Sites, others: float) -> Outlier | None:
    """Return a contact as an outlier, if another place explains it by the standard of the others' mean ratio."""
    contacts = ratios.sites
    tried = Sites(*(torch.cat(both) for both in zip(*((each.points, each.directions) for each in (contacts, places)))))
    found = ratios.elsewhere(row, aside, tried)
    own = float(found[0, row])
    needed = max(own + _BETTER, _BETTER_SHARE * others)
    best = int(found.amax(0).argmax())
    ratio = float(found[:, best].max())
    if ratio < needed:
        return None
    place = tried.points[best]
    distance = float((place - contacts.points[row]).norm())
    x, y, z = place.tolist()
    return Outlier(row, own, (x, y, z), ratio, distance, float(found[1, row]) >= needed)


def _log_student(error: Tensor, variance: Tensor, whole: Tensor, count: int) -> Tensor:
    """Return the log density of one of `count` values given the others, up to a constant of their number.

    `whole` is y' C^-1 y of all of them, error and variance (over the scale) those of the prediction from the others.
    """
    rest = (whole - error.square() / variance).clamp_min(_TINY)
    return -0.5 * (count * whole.clamp_min(_TINY).log() - (count - 1) * rest.log() + variance.log())
