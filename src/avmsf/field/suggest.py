"""Where to strike next: the places whose sounds would tell most of the sounds everywhere else."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from avmsf.errors import FitError
from avmsf.field.gains.model import MixtureGains, PlaceCovariance
from avmsf.field.hammer_access import HAMMER_DIAMETER, MeshAccess, PointAccess
from avmsf.field.posterior import energy_of, parts_of, unedited_mixture
from avmsf.field.soundfield import SoundField
from avmsf.scene.points import farthest_points

PLACES = 400
"""Points of the surface that the expected error is summed over, and that are candidates unless others are given."""
MOST = 500
"""Candidates that are weighed; of more, as many that lie far apart. What is kept of them grows with their square."""
_OFF = 0.05
"""Distance of a candidate from the surface over the object's size, from which on it is not on the object."""
_SAME = 1e-6
"""Distance between two places over the object's size, below which they are one."""


@dataclass(frozen=True, eq=False)
class Suggestions:
    """Where to strike next, in this order, and what that is expected to bring.

    Errors are relative: the square root of the expected squared error of the gains, as energy, over the energy that is
    expected on the mean over the surface. 0 is certainty, 1 as wrong as silence.
    """

    contacts: Float64[Tensor, "contacts 3"]
    """Object frame, metres."""
    directions: Float64[Tensor, "contacts 3"] | None
    """Unit vectors along which to strike: as given, or straight into the body; None where the field knows nothing of
    directions."""
    rows: Int[Tensor, " contacts"]
    """Which of the candidates they are."""
    before: float
    """Expected error of the whole field with what has been struck."""
    after: tuple[float, ...]
    """Expected error of the whole field after each of the contacts and those before it."""
    points: Float64[Tensor, "points 3"]
    """Points spread evenly over the surface, metres."""
    map_before: Float64[Tensor, " points"]
    """Expected error at these with what has been struck."""
    map_after: Float64[Tensor, " points"]
    """Expected error at these after all the contacts."""
    unreachable: int = 0
    """How many of `points` were no candidates because a hammer cannot strike them from outside."""


def suggest(
    field: SoundField,
    count: int = 5,
    *,
    candidates: Float[Tensor, "candidates 3"] | None = None,
    directions: Float[Tensor, "_given 3"] | None = None,
    unseen: bool = False,
) -> Suggestions:
    """Return the `count` contacts that lower the expected error of the whole field most, each given those before it.

    Gains at two places hang together as far as the field believes they do, so a blow tells of other places too; its
    expected gain is known before it is struck, for in a Gaussian field it does not depend on what will be heard.
    `candidates` are the places to choose from (metres, on the surface; places that have been struck are passed over,
    but for those of strikes whose labels the field holds for wrong), by itself points spread over the surface that a
    hammer can strike from outside (`hammer_access`); `directions` the unit vectors along which they can be struck,
    straight into the surface where not given. Of more than `MOST` candidates as many are weighed, spread as far apart
    as they go. A field made of photographs has points where they show the object; with `unseen`, error and candidates
    are those of all of the surface of the field's body instead.

    Raises FitError for gains that know no doubt, a count below 1, candidates that are not finite or not on the object,
    directions that are not one a candidate, fewer candidates than contacts asked for, places none of which a hammer
    gets to, and `unseen` without a body.
    """
    gains = unedited_mixture(field)
    surface = _body_nodes(gains) if unseen else gains.points
    points = surface[farthest_points(surface, min(PLACES, len(surface)))].double()
    _expect(gains.points, count, candidates)
    _expect_directions(directions, candidates)
    if candidates is None:
        chosen_from = reachable(gains, points)
        unreachable = len(points) - len(chosen_from)
    else:
        chosen_from, unreachable = candidates.double(), 0
    size = float((points.amax(0) - points.amin(0)).norm())
    allowed = _apart(chosen_from, gains.contacts, size=size)
    if int(allowed.sum()) < count:
        raise FitError(
            f"{count} contacts are asked for and {int(allowed.sum())} of the {len(chosen_from)} candidates have not "
            "been struck yet: ask for fewer, or give more candidates"
        )
    kept = _weighed(chosen_from, allowed, max(MOST, count))
    chosen_from, allowed = chosen_from[kept], allowed[kept]
    along = gains.sites(chosen_from, None if directions is None else directions[kept]).directions
    places = torch.cat([points, chosen_from])
    ways = torch.cat([gains.sites(points).directions, along])
    ledger = _Ledger(
        gains.covariances(places, ways), 1.0 / (4.0 * field.bank.damping.double()), len(points), len(chosen_from)
    )
    energy = float(energy_of(field, parts_of(field, points.float())).mean()) + float(ledger.open.mean())
    before, rows, after = ledger.open, [], []
    for _ in range(count):
        row = int(torch.where(allowed, ledger.worth(), -math.inf).argmax())
        ledger.strike(row)
        allowed &= _apart(chosen_from, chosen_from[row : row + 1], size=size)
        rows.append(row)
        after.append(math.sqrt(float(ledger.open.mean()) / energy))
        if not bool(allowed.any()):
            break
    if len(rows) < count:
        raise FitError(f"{count} contacts are asked for and the candidates are only {len(rows)} different places")
    return Suggestions(
        chosen_from[rows],
        along[rows] if gains.directional else None,
        kept[rows],
        math.sqrt(float(before.mean()) / energy),
        tuple(after),
        points,
        (before / energy).sqrt(),
        (ledger.open / energy).sqrt(),
        unreachable,
    )


def reachable(gains: MixtureGains, points: Float64[Tensor, "points 3"]) -> Float64[Tensor, "places 3"]:
    """Return those of the points, moved onto the surface of the gains' body, that a hammer can strike from outside.

    Without a body they are judged by the object's points, and stay where they are. Raises FitError where none can be.
    """
    body = gains.body
    judge = (
        PointAccess(gains.points.double().numpy())
        if body is None
        else MeshAccess(body.nodes.double().numpy(), body.triangles[:, :3].numpy())
    )
    struck, places = judge(points.numpy())
    if not struck.any():
        raise FitError(
            f"expected places that a hammer of {1000 * HAMMER_DIAMETER:g} mm can strike from outside, got none of "
            f"{len(points)}: the object's shape is wrong or closed; give candidates"
        )
    return torch.from_numpy(places[struck])


def _body_nodes(gains: MixtureGains) -> Float64[Tensor, "nodes 3"]:
    """Return places all over the body's surface. Raises FitError without a body."""
    if gains.body is None:
        raise FitError(
            "expected a field that knows the object's surface, of which no view saw a part, got one without a body: "
            "ask without unseen places, or give candidates"
        )
    return gains.body.nodes


class _Ledger:
    """What is not known yet, mode by mode, while strikes are added that have not been made."""

    def __init__(
        self,
        covariances: Iterator[PlaceCovariance],
        weights: Float64[Tensor, " modes"],
        points: int,
        candidates: int,
    ) -> None:
        self.scatter: list[float] = []
        self.shared: list[Float64[Tensor, "places candidates"]] = []
        """Covariances between all places and the candidates, which are the last of the places."""
        self.points, self.candidates = points, candidates
        self.open = torch.zeros(points, dtype=torch.float64)
        """Variance at the points, all modes together."""
        for weight, known in zip(weights.tolist(), covariances, strict=True):
            self.open = self.open + weight * torch.diagonal(known.covariance)[:points].clamp_min(0.0)
            self.shared.append(weight * known.covariance[:, -candidates:])
            self.scatter.append(weight * known.noise)

    def worth(self) -> Float64[Tensor, " candidates"]:
        """Return by how much each candidate would lower the variance, summed over the points."""
        total = torch.zeros(self.candidates, dtype=torch.float64)
        for shared, scatter in zip(self.shared, self.scatter, strict=True):
            total += shared[: self.points].square().sum(0) / self._measured(shared, scatter)
        return total

    def strike(self, row: int) -> None:
        """Take account of a blow at a candidate."""
        for shared, scatter in zip(self.shared, self.scatter, strict=True):
            column = shared[:, row].clone()
            measured = self._measured(shared, scatter)[row]
            self.open = (self.open - column[: self.points].square() / measured).clamp_min(0.0)
            shared -= torch.outer(column, column[-self.candidates :]) / measured

    def _measured(self, shared: Tensor, scatter: float) -> Float64[Tensor, " candidates"]:
        own = torch.diagonal(shared[-self.candidates :]).clamp_min(0.0)
        return (own + scatter).clamp_min(torch.finfo(torch.float64).tiny)


def _weighed(
    places: Float64[Tensor, "candidates 3"], allowed: Bool[Tensor, " candidates"], most: int
) -> Int[Tensor, " weighed"]:
    """Return the candidates' rows, or of too many of them some that are allowed and far apart, in the same order."""
    if len(places) <= most:
        return torch.arange(len(places))
    open_to = torch.nonzero(allowed).flatten()
    return open_to[farthest_points(places[open_to], min(most, len(open_to)))].sort().values


def _apart(
    places: Float64[Tensor, "places 3"], others: Float64[Tensor, "others 3"], *, size: float
) -> Bool[Tensor, " places"]:
    """Return whether each place is none of the others."""
    distance = (places[:, None, :] - others).square().sum(2).sqrt()
    return distance.amin(1) > _SAME * size


def _expect_directions(directions: Float[Tensor, "_given 3"] | None, candidates: Tensor | None) -> None:
    if directions is None:
        return
    if candidates is None:
        raise FitError("directions are given and no candidates: give the places that can be struck along them")
    if len(directions) != len(candidates):
        raise FitError(
            f"expected a direction for each of the {len(candidates)} candidates, found {len(directions)} directions"
        )
    still = torch.nonzero(~(directions.norm(dim=1) > 0)).flatten().tolist()
    if still:
        raise FitError(f"candidate {still[0]}: its direction is a vector of length zero: give the way the hammer moves")


def _expect(surface: Float[Tensor, "points 3"], count: int, given: Float[Tensor, "candidates 3"] | None) -> None:
    if count < 1:
        raise FitError(f"count = {count}: expected 1 contact or more")
    if given is None:
        return
    candidates = given.double()
    if len(candidates) == 0:
        raise FitError("candidates is empty: give places on the surface, in metres, or none at all")
    if not bool(torch.isfinite(candidates).all()):
        row = int(torch.nonzero(~torch.isfinite(candidates).all(1))[0])
        raise FitError(f"candidate {row} is {candidates[row].tolist()}: expected finite coordinates in metres")
    points = surface.double()
    size = float((points.amax(0) - points.amin(0)).norm())
    distance = torch.cat(
        [(part[:, None, :] - points).square().sum(2).amin(1).sqrt() for part in torch.split(candidates, 256)]
    )
    worst = int(distance.argmax())
    if float(distance[worst]) > _OFF * size:
        raise FitError(
            f"candidate {worst} at {[round(each, 4) for each in candidates[worst].tolist()]} m is "
            f"{float(distance[worst]):.2g} m from the object's surface: candidates lie on it, in metres, in the "
            "object's frame"
        )
