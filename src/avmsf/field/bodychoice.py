"""Which body lies behind a surface, and how its elastic frequencies become the measured ones, by evidence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.field.elasticpoints import ElasticPoints
from avmsf.field.evidence import Regression
from avmsf.field.hypotheses import WIDTHS, nearness
from avmsf.field.modalbasis import ModalBasis, fit_modal_basis, sites_of
from avmsf.simulate.nominal import NominalBody

_FACTORS = torch.exp(torch.arange(-60, 61, dtype=torch.float64) * 0.05)
"""Measured over elastic frequencies that are tried: stiffness and size are not known."""
_KNOWN = 0.5
"""Standard deviation of the log of that factor beforehand: of plastics it is -1.3, of all that rings about 0."""
_LAG = 10.0
"""Nats by which a factor may suit the frequencies less than the best and still be asked of the gains."""
_EVERY = 2
"""Steps between factors among which suspects are looked for."""
_APART = 0.2
"""Log of a factor over another from which on they are two answers."""
_STRAY = 0.2
"""Part of the measured modes that may be no mode of the body: another's, or a doublet's second half."""
_STRONGEST = 16
"""Modes that choose, those of the most energy: among weak ones there are many that are none of the body's."""


@dataclass(frozen=True, eq=False)
class MeasuredGains:
    """The gains of some contacts in all modes, as a regression takes them."""

    contacts: Float[Tensor, "contacts 3"]
    """Object frame, metres."""
    directions: Float[Tensor, "contacts 3"] | None
    """Unit vectors along which they were struck, where known."""
    values: Float64[Tensor, "contacts modes 2"]
    """Gains in two parts."""
    frequency: Float64[Tensor, " modes"]
    """Of the measured modes, Hz."""
    damping: Float64[Tensor, " modes"]
    """1/s."""
    floor: Float64[Tensor, "contacts modes"]
    """Variance of the gains by the extraction's own error, over each mode's mean square gain."""
    doubt: Float64[Tensor, " contacts"]
    """Factor on the variance of the noise at each contact."""

    def strongest(self, count: int = _STRONGEST) -> "MeasuredGains":
        """Return the modes of the most energy alone, in the same order."""
        energy = self.values.square().sum((0, 2)) / self.damping
        rows = torch.sort(torch.topk(energy, min(count, len(energy))).indices).values
        return MeasuredGains(
            self.contacts,
            self.directions,
            self.values[:, rows],
            self.frequency[rows],
            self.damping[rows],
            self.floor[:, rows],
            self.doubt,
        )


@dataclass(frozen=True, eq=False)
class ChosenBody:
    """A body, and the factor that its frequencies take."""

    body: NominalBody
    """Itself, for names may be alike."""
    surface: ElasticPoints
    elastic: Float64[Tensor, " shapes"]
    """Frequencies of the body's shapes times the factor, Hz."""
    factor: float
    lag: float
    """Log of the likeliest body's evidence over this one's."""
    suits: float
    """Log likelihood of the measured frequencies, up to a constant of their number."""

    @property
    def name(self) -> str:
        """What it is, for people."""
        return self.body.name

    def fit(self, measured: MeasuredGains) -> ModalBasis:
        """Return the field of this body."""
        return fit_modal_basis(
            self.surface,
            self.elastic,
            measured.contacts,
            measured.directions,
            measured.values,
            frequency=measured.frequency,
            floor=measured.floor,
            doubt=measured.doubt,
        )


def likely_bodies(
    bodies: Sequence[NominalBody], points: Float[Tensor, "points 3"], measured: MeasuredGains
) -> tuple[ChosenBody, ...]:
    """Return bodies with factors by their evidence, the likeliest first; one body's factors are well apart.

    Frequencies and gains are taken together. The gains have their evidence from the regression; the frequencies from a
    density about the body's own, `WIDTHS` wide, in which a fifth of the modes may be strays.
    """
    strong = measured.strongest()
    surfaces = [ElasticPoints.of(body.elastic, points) for body in bodies]
    likely = torch.stack([_frequencies_suit(strong.frequency, body.elastic.frequency) for body in bodies])
    trials = []
    for body, surface, suits in zip(bodies, surfaces, likely, strict=True):
        kept = torch.nonzero(suits > likely.max() - _LAG).flatten()
        if len(kept):
            evidence = suits[kept] + _gains_suit(strong, surface, body.elastic.frequency, _FACTORS[kept])
            for scale, own, total in zip(_FACTORS[kept].tolist(), suits[kept].tolist(), evidence.tolist(), strict=True):
                trials.append((total, ChosenBody(body, surface, body.elastic.frequency * scale, scale, 0.0, own)))
    trials.sort(key=lambda each: -each[0])
    found: list[ChosenBody] = []
    for evidence, each in trials:
        near = (known for known in found if known.body is each.body)
        if all(abs(math.log(each.factor / known.factor)) >= _APART for known in near):
            found.append(replace(each, lag=trials[0][0] - evidence))
    return tuple(found)


def plausible_bodies(
    bodies: Sequence[NominalBody], points: Float[Tensor, "points 3"], measured: MeasuredGains
) -> tuple[ChosenBody, ...]:
    """Return bodies with every factor that suits the frequencies, whatever the gains say: wrong ones mislead."""
    strong = measured.strongest()
    likely = torch.stack([_frequencies_suit(strong.frequency, body.elastic.frequency) for body in bodies])
    found = []
    for body, suits in zip(bodies, likely, strict=True):
        surface = ElasticPoints.of(body.elastic, points)
        for row in torch.nonzero(suits > likely.max() - _LAG).flatten().tolist()[::_EVERY]:
            scale = float(_FACTORS[row])
            found.append(ChosenBody(body, surface, body.elastic.frequency * scale, scale, 0.0, float(suits[row])))
    return tuple(found)


def _frequencies_suit(
    measured: Float64[Tensor, " modes"], elastic: Float64[Tensor, " shapes"]
) -> Float64[Tensor, " factors"]:
    """Return the log likelihood of each factor on the elastic frequencies, given the measured ones."""
    apart = torch.log(measured) - torch.log(_FACTORS[:, None, None] * elastic[:, None])
    widths = torch.tensor(WIDTHS, dtype=torch.float64)[:, None, None, None]
    bells = torch.exp(-0.5 * (apart / widths).square()) / (widths * math.sqrt(2.0 * math.pi))
    lowest, highest = measured.min(), measured.max()
    scaled = _FACTORS[:, None] * elastic
    heard = ((scaled > lowest / 1.2) & (scaled < highest * 1.2)).sum(1).clamp_min(1)
    density = bells.sum(2) / heard[:, None]
    stray = _STRAY / math.log(float(highest / lowest) * 1.44)
    # One width for all modes, of which none is likelier beforehand.
    together = torch.log((1.0 - _STRAY) * density + stray).sum(2)
    return torch.logsumexp(together, dim=0) - 0.5 * (torch.log(_FACTORS) / _KNOWN).square()


def _gains_suit(
    measured: MeasuredGains,
    surface: ElasticPoints,
    elastic: Float64[Tensor, " shapes"],
    factors: Float64[Tensor, " factors"],
) -> Float64[Tensor, " factors"]:
    """Return the evidence of the gains for each factor on the elastic frequencies, as `ChosenBody.fit` would find it.

    A factor changes the prior alone: what is known of the contacts is looked up once for all.
    """
    sites, _ = sites_of(surface, measured.contacts, measured.directions)
    priors = nearness(measured.frequency, (factors[:, None] * elastic).flatten())
    return Regression.evidence_of(
        sites,
        priors.reshape(*priors.shape[:2], len(factors), len(elastic)).movedim(2, 0),
        measured.values,
        floor=measured.floor,
        doubt=measured.doubt,
    )
