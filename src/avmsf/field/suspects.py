"""Strikes that disagree with all others: a wrong row in the table of contacts, or a direction turned round."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.field.bodychoice import ChosenBody, MeasuredGains
from avmsf.field.hypotheses import NOISES, REMAINDERS, UNHEARD, WIDTHS, Hypotheses, nearness, row_of
from avmsf.field.modalbasis import REACH, remainder_kernel, sites_of

_WIDTH, _REMAINDER, _NOISE = WIDTHS.index(0.2), REMAINDERS.index(0.1), NOISES.index(0.1)
"""What strikes are compared by: not what the gains make likeliest, for wrong ones make noise likeliest."""
_COST = 0.8
"""Squared misfit over that of silence, summed over all strikes, that taking one out has to save.

On the aircraft, of 15 strikes with right labels none saves so much; three that have changed places save 1 to 4 each.
"""
_ENOUGH = 1.5
"""Misfit beyond which a strike could not be more wrong."""
_MOST = 0.25
"""Part of the strikes that may be suspect: more than that, and it is the model that is wrong."""
_FEWEST = 6
"""Strikes below which none can be told from the others."""
_BODIES = 6
"""Most of the likeliest bodies that are asked."""
_ASKED = 16
"""Bodies that are asked which strikes are wrong."""
_WITNESSES = 4
"""Bodies that have to agree on which strikes are wrong."""
_LAG = 12.0
"""Nats of evidence that a body may lack of the likeliest."""
_NATS = 10.0
"""Log likelihood of frequencies that counts as much as one strike that is foretold no better than by silence."""
_FLOOR = 1e-3
"""Least scatter of a mode's gains, over their mean square."""
_NEAR = 0.05
"""Distance over the object's size up to which a place is the label's own."""
_NOWHERE = 0.55
"""Misfit beyond which a place does not explain a strike."""
_FAR = 0.25
"""Distance over the object's size from which on another place is quite another."""
_BETTER_NEAR, _BETTER_FAR = 0.25, 0.35
"""Misfit at the best place, near to the label or far, over that at the label, below which the label is wrong: few
strikes tell little of one, and shapes that are a little off look like a place that is."""
_BETTER_HEARD = 0.2
"""The same of a far place, for a strike that fits its label well enough to speak: on the other side of a symmetric
object half of the modes are as strong, and it is wrong all the same."""
_SILENT = 1e12
"""Misfit that only a strike without any sound can have."""
_SURELY = 2.0
"""Misfit from which on a strike is wrong even if no place explains it; else it may be one that nobody else tells of."""


@dataclass(frozen=True)
class Suspect:
    """A strike whose gains do not belong where its label says."""

    row: int
    """Among the training contacts."""
    misfit: float
    """Squared misfit at its label over that of silence."""
    distance: float
    """Metres from its label to the place of the surface that its gains fit best."""
    reversed: bool
    """Whether they fit best with a blow against the direction that the label says."""
    best: float
    """Squared misfit there, over that of silence."""
    size: float
    """Of the object, metres."""
    place: tuple[float, float, float]
    """The place that they fit best, metres."""

    @property
    def is_wrong(self) -> bool:
        """Whether the label is: another place explains the strike, or nothing could be worse."""
        better = _BETTER_FAR if self._far else _BETTER_NEAR
        return self.best < better * self.misfit or self.misfit > _SURELY

    @property
    def is_elsewhere(self) -> bool:
        """Whether the strike fits far better in quite another place, however well it fits its own."""
        return self._far and self.best < _BETTER_HEARD * self.misfit

    @property
    def _far(self) -> bool:
        return self.distance > _FAR * self.size

    def describe(self, names: Sequence[str], contacts: Float[Tensor, "contacts 3"]) -> str:
        """Say what is wrong with it, by the names and places (metres) of all training contacts."""
        if self.misfit > _SILENT:
            return f"{names[self.row]} is silent"
        turned = " with its direction reversed" if self.reversed else ""
        where = "there"
        if self.best > _NOWHERE:
            found, where = "fits nowhere on the object", "at best"
        elif self.distance < 1e-9:
            found = f"fits best{turned}" if turned else "fits its place badly"
        else:
            place = ", ".join(f"{each + 0.0:.4g}" for each in self.place)
            found = f"fits best {self.distance:.2g} m away, at ({place}) m{self._beside(names, contacts)}{turned}"
        return (
            f"{names[self.row]} {found} (misfit {self.misfit:.2g} where it is said to be, {self.best:.2g} {where}; "
            "0 is a strike explained, 1 as badly as by silence)"
        )

    def _beside(self, names: Sequence[str], contacts: Float[Tensor, "contacts 3"]) -> str:
        """Say which other contact is said to be where this one fits best: their labels may have changed places."""
        apart = (contacts.double() - torch.tensor(self.place, dtype=torch.float64)).norm(dim=1)
        apart[self.row] = math.inf
        other = int(apart.argmin())
        return f", near to where {names[other]} is said to be" if float(apart[other]) <= _NEAR * self.size else ""


def agreeing(bodies: Sequence[ChosenBody], measured: MeasuredGains) -> ChosenBody:
    """Return the one of the likely bodies with which strikes that are left out in turn are foretold best.

    Few strikes' evidence is won by single modes; being left out, all strikes have a say. Bodies whose evidence lags far
    behind are not asked, and how well the frequencies are met counts as well.
    """
    strong = measured.strongest()
    silent = frozenset(torch.nonzero(measured.doubt > 1.0).flatten().tolist())
    asked = [body for body in bodies if body.lag <= _LAG][:_BODIES]
    return min(asked, key=lambda body: _Judge(body, strong).cost(silent) - body.suits / _NATS)


def find_suspects(bodies: Sequence[ChosenBody], measured: MeasuredGains) -> tuple[Suspect, ...]:
    """Return the strikes without which all others foretell one another best, worst first.

    A strike is foretold by all others that speak. Taking one out has to save a sum of misfits, its own and what it does
    to the others'; strikes are taken out, put back and exchanged as long as that helps, a quarter of them at most.
    Then those follow that fit far better far away. Judged by the strongest modes, and by those of the plausible
    `bodies` with which strikes agree best in the end, of which most have to call a strike wrong. Evidence would ask the
    wrong bodies, for wrong strikes are part of it.
    """
    strong = measured.strongest()
    if len(strong.contacts) < _FEWEST:
        return ()
    witnesses, silent = _silenced([_Judge(body, strong) for body in bodies])
    wrong = []
    for row in sorted(silent):
        found = [witness.located(row, silent) for witness in witnesses]
        if 2 * sum(each.is_wrong for each in found) > len(found):
            wrong.append(next(each for each in found if each.is_wrong))
    wrong += _elsewhere(witnesses, wrong)
    return tuple(sorted(wrong, key=lambda each: -each.misfit))


def _elsewhere(witnesses: Sequence["_Judge"], wrong: Sequence[Suspect]) -> list[Suspect]:
    """Return more strikes that fit far better far away, the most telling first, once the wrong ones no longer speak."""
    found: list[Suspect] = []
    rows = range(len(witnesses[0].power))
    while len(wrong) + len(found) < int(_MOST * len(rows)):
        silent = frozenset(each.row for each in (*wrong, *found))
        told = [[witness.located(row, silent | {row}) for witness in witnesses] for row in rows if row not in silent]
        agreed = [each for each in told if 2 * sum(one.is_elsewhere for one in each) > len(each)]
        if not agreed:
            break
        clearest = min(agreed, key=lambda each: math.prod(one.best / max(one.misfit, _FLOOR) for one in each))
        found.append(next(one for one in clearest if one.is_elsewhere))
    return found


def _silenced(judges: Sequence["_Judge"]) -> tuple[list["_Judge"], frozenset[int]]:
    """Return those of the bodies that strikes agree with best, and the strikes that they together would leave out."""
    none: frozenset[int] = frozenset()
    asked = sorted(judges, key=lambda judge: judge.cost(none) + judge.handicap)[:_ASKED]
    quick = {judge: _lessened(judge, none, exchange=False) for judge in asked}
    best = sorted(asked, key=lambda judge: quick[judge][0] + judge.handicap)[:_WITNESSES]
    offered = {_lessened(judge, quick[judge][1], exchange=True)[1] for judge in best}
    return best, min(sorted(offered, key=sorted), key=lambda silent: sum(judge.cost(silent) for judge in best))


def doubted(measured: MeasuredGains, suspects: Sequence[Suspect]) -> MeasuredGains:
    """Return the gains with suspects counting for nothing."""
    doubt = measured.doubt.clone()
    doubt[[each.row for each in suspects]] = UNHEARD
    return replace(measured, doubt=doubt)


def _lessened(judge: "_Judge", silent: frozenset[int], *, exchange: bool) -> tuple[float, frozenset[int]]:
    """Return the least cost that is found from some silent strikes on, and those that are silent then."""
    count = len(judge.power)
    cost = judge.cost(silent)
    while True:
        near = [silent ^ {row} for row in range(count)]
        if exchange:
            near += [silent - {out} | {row} for out in silent for row in range(count) if row not in silent]
        allowed = [each for each in near if len(each) <= int(_MOST * count)]
        costs = [judge.cost(each) for each in allowed]
        best = min(range(len(allowed)), key=costs.__getitem__)
        if costs[best] >= cost:
            return cost, silent
        silent, cost = allowed[best], costs[best]


class _Judge:
    """Foretells strikes from others, by one hypothesis for all modes."""

    def __init__(self, body: ChosenBody, measured: MeasuredGains) -> None:
        self.body, self.measured = body, measured
        sites, self.directions = sites_of(body.surface, measured.contacts, measured.directions)
        prior = nearness(measured.frequency, body.elastic)
        self.known = Hypotheses(sites, prior, measured.values, measured.floor, measured.doubt)
        hypothesis = torch.tensor([row_of(_WIDTH, _REMAINDER, _NOISE)])
        self.covariance = self.known.covariance(torch.arange(len(prior)), hypothesis)[0]
        self.values = measured.values.transpose(0, 1)
        self.power = measured.values.square().sum(2)

    @property
    def handicap(self) -> float:
        """What the frequencies say against the body, as cost."""
        return -self.body.suits / _NATS

    def cost(self, silent: frozenset[int]) -> float:
        """Return the sum of the misfits of those that speak, and of the price for those that do not."""
        speaking, _, errors = self._left_out(silent)
        misfits = self._relative(errors, self.power[speaking], self._scatter(errors, speaking))
        return float(misfits.clamp_max(_ENOUGH).sum()) + _COST * len(silent)

    def located(self, row: int, silent: frozenset[int]) -> Suspect:
        """Return where on the surface, and which way round, a strike fits best, foretold by those that speak."""
        speaking, solved, errors = self._left_out(silent)
        scatter = self._scatter(errors, speaking)
        surface = self.body.surface
        places = torch.cat([self.measured.contacts[row : row + 1].double(), surface.points[surface.spread].double()])
        directions = torch.cat([self.directions[row : row + 1], surface.inward[surface.spread].double()])
        cross = torch.cat([self.covariance[:, row : row + 1], self.elsewhere], dim=1)
        there = (cross[:, :, speaking] @ solved).transpose(0, 1)
        both = torch.stack([there, -there])
        squares = (self.measured.values[row] - both).square().sum(3)
        misfits = self._relative(squares, self.power[row], scatter)
        turned, place = divmod(int(misfits.argmin()), len(places))
        distance = float((places[place] - places[0]).norm())
        # Straight in may be against the label's own direction, as it is next to a label that is turned round.
        along = float(directions[place] @ directions[0])
        against = (along < 0) != bool(turned)
        # Elsewhere, or where no direction was given, a turned blow says nothing of the label's direction.
        near = distance <= _NEAR * surface.size
        against = against and near and self.measured.directions is not None
        x, y, z = places[place].tolist()
        best = float(misfits[turned, place])
        return Suspect(row, float(misfits[0, 0]), distance, against, best, surface.size, (x, y, z))

    @cached_property
    def elsewhere(self) -> Float64[Tensor, "modes places contacts"]:
        """Covariance of gains at places all over the surface, struck straight in, with those at the contacts."""
        surface = self.body.surface
        points, inward = surface.points[surface.spread].double(), surface.inward[surface.spread].double()
        shapes, used = surface.along(points, inward)
        contacts, reach = self.measured.contacts.double(), REACH * surface.size
        across = remainder_kernel(points, used, contacts, self.directions, reach=reach)
        return self.known.kernel(shapes, across, _WIDTH, _REMAINDER)

    def _left_out(
        self, silent: frozenset[int]
    ) -> tuple[list[int], Float64[Tensor, "modes speaking 2"], Float64[Tensor, "speaking modes"]]:
        """Return who speaks, their gains over their covariance, and the squared error of each foretold by the rest."""
        speaking = [row for row in range(len(self.power)) if row not in silent]
        inverse = torch.linalg.inv(self.covariance[:, speaking][:, :, speaking])
        solved = inverse @ self.values[:, speaking]
        errors = (solved / torch.diagonal(inverse, dim1=1, dim2=2)[..., None]).square().sum(2).T
        return speaking, solved, errors

    def _scatter(self, errors: Float64[Tensor, "speaking modes"], speaking: list[int]) -> Float64[Tensor, " modes"]:
        least = _FLOOR * self.power.mean(0)
        return (errors.median(0).values + least).clamp_min(torch.finfo(torch.float64).tiny)

    def _relative(
        self, squares: Float64[Tensor, "*contacts modes"], power: Float64[Tensor, "*speaking modes"], scatter: Tensor
    ) -> Float64[Tensor, "*contacts"]:
        """Return squared misfits over what silence would have, every mode by how well it is foretold."""
        silence = (power / scatter).sum(-1).clamp_min(torch.finfo(torch.float64).tiny)
        return (squares / scatter).sum(-1) / silence
