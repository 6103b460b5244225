"""Whether contacts lie on the object's surface, and where they do not, the similarity that brings them onto it."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import CaptureError, FitError
from avmsf.mesh.surface import MOST_POINTS

TOLERANCE = 0.05
"""Distance from the surface, over the object's diagonal, up to which a contact lies on it.

On the aircraft, measured by hand against a nominal surface, the farthest of 74 contacts lies .004 off.
"""
SPREAD = 0.05
"""Diagonal of the contacts over the object's, below which their unit must be another."""
OTHER_SIZE = 0.25
"""Logarithm of a scale beyond which it is another object's: what materials cannot explain either."""
WRONG_ROWS = 0.1
"""Part of the contacts up to which those that lie off count as single mistakes, not as one made with all of them."""
LEAST_CLOSE = 5
"""Contacts on the surface from which on their small spread alone shows another unit, as for axes."""
LEAST_SPREAD = 0.4
"""Diagonal of the contacts over the object's that the undoing of a mistake must leave: what is shrunk enough fits
anywhere."""
RESOLUTION = 1 / 200
"""Distance over the diagonal below which contacts lie equally well: points are no surface, nor contacts exact."""
ODDS = 3.0
"""Nats of a contact that is a mistake of its own, as one of twenty is."""
MOST_CONTACTS = 200
"""As many, and as many points as `MOST_POINTS`, are compared, evenly taken from all, in search for the similarity."""
UNITS = {1e-3: "mm", 1e-2: "cm", 0.0254: "inches", 0.3048: "feet"}
_IDENTITY = torch.eye(3, dtype=torch.float64)
FACTORS = (1.0, *(power for size in (1000.0, 100.0, 10.0, 25.4, 0.0254, 0.3048) for power in (size, 1 / size)))


@dataclass(frozen=True, eq=False)
class Mistake:
    """What may have been done to all contacts, by how it is undone: x becomes `factor` * `axes` x + `shift`."""

    factor: float
    axes: Float[Tensor, "3 3"]
    """A permutation with signs; float64."""
    shift: Float[Tensor, " 3"]
    """Meters; float64."""
    distance: float = 0.0
    """Meters within which nine of ten contacts lie off the surface once it is undone."""
    stated: str = ""
    """Words of a file that says so; then `axes` is any rotation."""

    def undo(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts 3"]:
        """Return where the contacts were meant, float64."""
        return self.factor * contacts.double() @ self.axes.T + self.shift

    @property
    def turned(self) -> bool:
        """Whether the axes are others, or mirrored."""
        return not torch.equal(self.axes, _IDENTITY)

    @property
    def unit_only(self) -> bool:
        """Whether the unit alone is wrong."""
        return not self.turned and not bool(self.shift.any())

    @property
    def unit(self) -> str | None:
        """Name of the unit that one of the two counts by mistake; None for another factor."""
        size = min(self.factor, 1 / self.factor)
        return next((name for meters, name in UNITS.items() if abs(size / meters - 1) < 1e-6), None)

    def __str__(self) -> str:
        within = f"they lie within {_length(self.distance)} of it"
        if self.stated:
            return f"{within} once moved as {self.stated} says that the object was: give both in one frame"
        steps, questions, unit, moved = [], [], self.unit, bool(self.shift.any())
        if self.factor != 1:
            ratio = self.factor if self.factor > 1 else 1 / self.factor
            steps.append(f"{'multiplied' if self.factor > 1 else 'divided'} by {ratio:.4g}")
            whose = "their unit" if self.factor < 1 else "the surface's unit"
            questions.append(f"is {whose} {unit}?" if unit else "are they and the surface of one scale?")
        if self.turned:
            steps.append(f"with (x, y, z) taken as {_written(self.axes)}")
            upright = "upside down?" if float(self.axes[2, 2]) < -0.9 else "does another axis point up?"
            questions.append("are the axes mirrored?" if float(torch.linalg.det(self.axes)) < 0 else upright)
        if moved:
            steps.append(f"moved by ({', '.join(f'{value:.3g}' for value in self.shift.tolist())}) m")
            questions.append("do the origins differ?")
        undone = ", ".join(steps) + "," * (len(steps) > 1)
        if self.factor != 1 and unit is None and moved:
            questions = ["are they in another frame?"]
        return f"{undone} {within}: {' '.join(questions)}"


@dataclass(frozen=True, eq=False)
class Placement:
    """How contacts lie to a surface."""

    distances: Float[Tensor, " contacts"]
    """From each contact to the surface's nearest point, meters, float64."""
    diagonal: float
    """Of the object's bounding box, meters."""
    spread: float
    """Diagonal of the contacts' bounding box, meters."""
    tolerance: float
    """Meters up to which a contact counts as on the surface: `TOLERANCE`, or more where the points are sparse."""
    mistake: Mistake | None = None
    """What would explain contacts off the surface; None where they lie on it, or nothing simple explains them."""

    @property
    def on_surface(self) -> bool:
        """Whether all contacts lie on the surface and nothing says that they were meant elsewhere."""
        return not self.off and not self.shrunken and self.mistake is None

    @property
    def shrunken(self) -> bool:
        """Whether the contacts lie in a spot so small that their unit must be another."""
        return 0 < self.spread < SPREAD * self.diagonal

    @property
    def other_unit(self) -> bool:
        """Whether contacts and surface count different units, beyond doubt: another one brings them onto the surface.

        Where they lie on it already, as first impacts near the middle of a plate do, only many that are very close
        together say so.
        """
        if self.mistake is None or self.mistake.unit is None:
            return False
        return self.mostly_off or (self.shrunken and len(self.distances) >= LEAST_CLOSE)

    @property
    def misplaced(self) -> bool:
        """Whether no shape can be used as it lies: turned, mirrored, of another size, or with most contacts off."""
        mistake = self.mistake
        if mistake is not None and (mistake.turned or self.mostly_off or abs(math.log(mistake.factor)) > OTHER_SIZE):
            return True
        return float(self.distances.median()) > self.tolerance

    @property
    def mostly_off(self) -> bool:
        """Whether more contacts lie off the surface than are single mistakes."""
        return len(self.off) > max(1, WRONG_ROWS * len(self.distances))

    @cached_property
    def off(self) -> tuple[int, ...]:
        """Rows of the contacts off the surface, the farthest first."""
        rows = torch.argsort(self.distances, descending=True)
        return tuple(row for row in rows.tolist() if float(self.distances[row]) > self.tolerance)

    def describe(self, names: Sequence[str] = (), *, what: str = "surface") -> str:
        """Return a message on the contacts off `what` there is, by these names or else by indices; "" for none."""
        if self.on_surface:
            return ""
        if self.off or not self.shrunken:
            farthest = float(self.distances.max())
            few = self.mistake is None and 2 * len(self.off) < len(self.distances) and not self.shrunken
            which = f"{len(self.off)} of {len(self.distances)} contacts lie" if few else "the contacts lie"
            relative = _ratio(farthest / self.diagonal)
            found = f"{which} up to {_length(farthest)} ({relative} object diagonals) off the {what}"
            if few:
                shown = ", ".join(names[row] if names else f"row {row}" for row in self.off[:8])
                return f"{found}, the others on it; check {shown}{', …' * (len(self.off) > 8)}"
        else:
            found = f"the contacts lie within {_length(self.spread)} on an object {_length(self.diagonal)} across"
        if self.mistake is not None:
            return f"{found}; {self.mistake}"
        if not self.off:
            return f"{found}; check that both are in one frame and unit"
        return (
            f"{found}, and no change of unit, axes or origin explains it: the {what} and the contacts are in different "
            "frames; give both in one (structure from motion chooses its own: see docs/visual-inputs.md; nerfstudio "
            "writes how it moved the object to dataparser_transforms.json, to be laid beside)"
        )


def check_placement(
    contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"], *, stated: Sequence[Mistake] = ()
) -> Placement:
    """Measure how far contacts lie from a surface given by its points, and seek the similarity that explains them best.

    Tried are what files have `stated`, the ratios of usual units and any scale, all 48 signed permutations of the axes,
    and a shift. Each has the nats of its parameters and of how far each contact is off (`_Search`); the least is
    reported unless it leaves the contacts where they are. Few contacts fit much by chance: axes are tried from five on,
    what is fitted from eight. Raises CaptureError where there are no contacts, or points without an extent.
    """
    places, cloud = contacts.double().numpy(), points.double().numpy()
    for name, values in (("contacts", places), ("points", cloud)):
        if not len(values) or not np.isfinite(values).all():
            raise CaptureError.expected(f"{name} with finite coordinates", len(values), name=name)
    diagonal = _diagonal(cloud)
    if not diagonal > 0:
        got = f"{len(cloud)} at one position"
        raise CaptureError.expected("points of an object with an extent", diagonal, got=got, name="points")
    tree = cKDTree(cloud)
    some = _some(cloud, MOST_POINTS)
    # Between points that lie far apart, a contact on the surface is far from all of them.
    spacing = float(np.quantile(tree.query(some, k=min(2, len(cloud)))[0].reshape(len(some), -1)[:, -1], 0.95))
    placement = Placement(
        distances=torch.from_numpy(tree.query(places)[0]),
        diagonal=diagonal,
        spread=_diagonal(places),
        tolerance=max(TOLERANCE * diagonal, 2 * spacing),
    )
    search = _Search(tree, _some(places, MOST_CONTACTS), placement, floor=spacing)
    return replace(placement, mistake=search.find(stated))


def expect_placed(
    contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"], *, names: Sequence[str] = ()
) -> None:
    """Raise FitError where contacts are not on a surface, with the transform that would bring them onto it.

    `points` are all over the surface, as `surface_points` has them; both in meters. Contacts are not on it where
    `Placement.misplaced` says so: rough surfaces, glue, single wrong rows and small shifts pass. `names` are for the
    message.
    """
    placement = check_placement(contacts, points)
    if not placement.misplaced:
        return
    advice = "Bring both into one frame, or use a gain model without elastic mode shapes"
    if placement.mistake is not None and placement.mistake.unit_only and placement.other_unit:
        advice = "State both units, as unit and surface_unit in capture.toml do, or give both in meters"
    raise FitError(
        f"expected contacts on the surface for elastic mode shapes, but {placement.describe(names)}. {advice}",
        name="contacts",
        value=float(placement.distances.max()),
    )


class _Search:
    """Similarities compared by description length: nats of the parameters, and of the distances that they leave.

    A distance d, or the least that counts where it is less, costs d^2 / (2 s^2) + log(s / scale), as with normal errors
    of a standard deviation s that is chosen for each similarity, or that of a contact which is a mistake of its own and
    lies anywhere. The scale makes what is shrunk no better than what it was. A parameter fitted to n contacts costs
    log(n).
    """

    def __init__(self, tree: cKDTree, contacts: np.ndarray, placement: Placement, *, floor: float) -> None:
        self.tree, self.contacts, self.placement = tree, contacts, placement
        self.cloud = np.asarray(tree.data)
        self.middle = (self.cloud.min(axis=0) + self.cloud.max(axis=0)) / 2
        self.floor = max(floor, RESOLUTION * placement.diagonal)
        widest = max(2 * self.floor, float(placement.distances.max()))
        steps = math.ceil(math.log(widest / self.floor, 1.5)) + 1
        self.deviations = np.geomspace(self.floor, widest, steps)[:, None]
        self.parameter = math.log(len(contacts))

    def find(self, stated: Sequence[Mistake] = ()) -> Mistake | None:
        """Return the similarity of the least description length; None where that changes nothing.

        What is `stated` goes first where it leaves most contacts near: what is fitted to few contacts and coarse points
        describes these better by chance.
        """
        present, least = self._nats(_UNCHANGED), len(self.contacts) * (math.log(self.floor) + 0.5)
        if present - least < 1:
            return None
        for each in stated:
            near, far = np.quantile(self._distances(each), (0.5, 0.9)).tolist()
            if near <= self.placement.tolerance and math.log(2) + self._nats(each) < present:
                return replace(each, distance=far)
        found = [(code + self._nats(each), each) for code, each in self._unmoved()]
        if len(self.contacts) >= 8:
            found += self._fitted()
        for nats, each in sorted(found, key=lambda pair: pair[0]):
            far = float(np.quantile(self._distances(each), 0.9))
            spread = each.factor * self.placement.spread or math.inf
            # Beside the size that the contacts have by then: what is shrunk comes nearer to anything.
            if nats < present and far <= min(max(self.floor, 0.5 * self.placement.tolerance), TOLERANCE * spread):
                return replace(each, distance=far)
        return None

    def _distances(self, mistake: Mistake) -> Float[np.ndarray, " contacts"]:
        return self.tree.query(mistake.undo(torch.from_numpy(self.contacts)).numpy())[0]

    def _nats(self, mistake: Mistake) -> float:
        if not mistake.factor > 0:
            return math.inf
        distances = self._distances(mistake)
        spread, diagonal = mistake.factor * self.placement.spread, self.placement.diagonal
        squares = np.square(np.maximum(distances, self.floor) / self.deviations)
        near = squares / 2 + np.log(self.deviations / min(mistake.factor, 1.0))
        anywhere = math.log(max(diagonal, self.placement.spread)) + ODDS
        # Contacts within a spot of an object are as unlikely as the spot is small.
        spot = max(0.0, math.log(SPREAD * diagonal / spread)) if spread else 0.0
        return float(np.minimum(near, anywhere).sum(axis=1).min()) + len(distances) * spot

    def _unmoved(self) -> Iterator[tuple[float, Mistake]]:
        """Yield the ratios of units that give contacts of about the object's size, with all axes."""
        spread, diagonal = self.placement.spread, self.placement.diagonal
        # What is symmetric but for errors of this size does not show which way it lies.
        off = float(self.placement.distances.max()) > self.placement.tolerance / 2
        turning = len(self.contacts) >= 5 and off
        for factor in FACTORS:
            if spread and factor != 1 and not LEAST_SPREAD * diagonal <= factor * spread <= 1.2 * diagonal:
                continue
            unit = 0.0 if factor == 1 else math.log(len(FACTORS))
            # Nothing in meters takes two mistakes.
            if factor != 1 and not any(math.isclose(min(factor, 1 / factor), each) for each in UNITS):
                unit *= 2
            for code, axes in _ways() if turning else _ways()[:1]:
                yield unit + code, replace(_UNCHANGED, factor=factor, axes=axes)

    def _fitted(self) -> list[tuple[float, Mistake]]:
        """Return what iterated closest points make of the likeliest, with a shift, a scale, and a turn."""
        scale = self.placement.diagonal / (self.placement.spread or math.inf)
        tried = []
        for code, each in self._unmoved():
            tried.append((code, self._centered(each), False, True))
            if each.factor == 1 and scale:
                code += 2 * math.log(len(FACTORS)) + self.parameter
                for factor in (1.0, 0.8 * scale, scale):
                    start = replace(each, factor=factor)
                    tried += [(code, start, True, False), (code, self._centered(start), True, True)]
        tried.sort(key=lambda start: start[0] + self._nats(start[1]))
        found = []
        for code, start, scaled, shifted in tried[:24]:
            fitted = self._closest(start, scaled=scaled, shifted=shifted)
            found.append((code + 3 * self.parameter * shifted + self._nats(fitted), fitted))
        return found

    def _centered(self, mistake: Mistake) -> Mistake:
        places = mistake.undo(torch.from_numpy(self.contacts)).numpy()
        middle = (places.min(axis=0) + places.max(axis=0)) / 2
        return replace(mistake, shift=mistake.shift + torch.from_numpy(self.middle - middle))

    def _closest(self, start: Mistake, *, scaled: bool, shifted: bool) -> Mistake:
        """Return the mistake with the scale and the shift that iterated closest points find from a start."""
        found, source = start, torch.from_numpy(self.contacts) @ start.axes.T
        old = source.mean(0) if shifted else torch.zeros(3, dtype=torch.float64)
        size = float((source - old).square().sum())
        for _ in range(60):
            nearest = self.tree.query((found.factor * source + found.shift).numpy())[1]
            target = torch.from_numpy(self.cloud[nearest])
            new = target.mean(0) if shifted else old
            factor = float(((source - old) * (target - new)).sum()) / size if scaled and size else found.factor
            found = replace(found, factor=factor, shift=new - factor * old)
        return found


_UNCHANGED = Mistake(1.0, _IDENTITY, torch.zeros(3, dtype=torch.float64))


def _ways() -> list[tuple[float, Tensor]]:
    """Return the 48 signed permutations, with the nats of its rarity: none, y-up for z-up, turns, mirrors."""
    ways = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = torch.diag(torch.tensor(signs, dtype=torch.float64)) @ _IDENTITY[list(order)]
            rarity = 48 if float(torch.linalg.det(axes)) < 0 else 6 if order == (0, 1, 2) else 24
            if (order, signs) == ((0, 1, 2), (1, 1, 1)):
                rarity = 1
            elif (order, signs) in (((0, 2, 1), (1, -1, 1)), ((0, 2, 1), (1, 1, -1))):
                rarity = 4
            ways.append((math.log(rarity), axes))
    return sorted(ways, key=lambda way: way[0])


def _written(axes: Tensor) -> str:
    rows = [int(row.abs().argmax()) for row in axes]
    return f"({', '.join(('-' if axes[row, name] < 0 else '') + 'xyz'[name] for row, name in enumerate(rows))})"


def _some(places: np.ndarray, most: int) -> np.ndarray:
    return places[:: -(-len(places) // most)]


def _diagonal(places: np.ndarray) -> float:
    return float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))


def _ratio(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def _length(meters: float) -> str:
    if meters < 0.01:
        return f"{meters * 1e3:.2g} mm"
    return f"{meters:.3g} m"
