"""Whether contacts lie on the object's surface, and where they do not, what mistake would explain it."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.capture.surface import Surface
from avmsf.errors import CaptureError, FitError

TOLERANCE = 0.05
"""Distance from the surface, over the object's diagonal, up to which a contact lies on it.

On the aircraft, measured by hand against a nominal surface, the farthest of 74 contacts lies .004 off.
"""
SPREAD = 0.05
"""Diagonal of the contacts over the object's, below which their unit must be another."""
SMALL_SPREAD = 0.15
"""The same, below which it may be."""
WRONG_ROWS = 0.1
"""Part of the contacts up to which those that lie off count as single mistakes, not as one made with all of them."""
LEAST_CLOSE = 5
"""Contacts on the surface from which on their small spread alone shows another unit, as for axes."""
LEAST_SPREAD = 0.4
"""Diagonal of the contacts over the object's that the undoing of a mistake must leave: what is shrunk enough fits
anywhere."""
GAIN = 3.0
"""How many times nearer to the surface a mistake mended must bring the contacts to be spoken of."""
MOST_CONTACTS, MOST_POINTS = 200, 20_000
"""As many are looked at, evenly taken from all, in search for the mistake."""
UNITS = {1e-3: "mm", 1e-2: "cm", 0.0254: "inches", 0.3048: "feet"}
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

    def undo(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts 3"]:
        """Return where the contacts were meant, float64."""
        return self.factor * contacts.double() @ self.axes.T + self.shift

    @property
    def unit_only(self) -> bool:
        """Whether the unit alone is wrong."""
        return bool(torch.equal(self.axes, torch.eye(3, dtype=torch.float64)) and not self.shift.any())

    def __str__(self) -> str:
        steps, questions = [], []
        if self.factor != 1:
            ratio = self.factor if self.factor > 1 else 1 / self.factor
            steps.append(f"{'multiplied' if self.factor > 1 else 'divided'} by {ratio:.4g}")
            size, whose = (self.factor, "their unit") if self.factor < 1 else (1 / self.factor, "the surface's unit")
            named = [name for meters, name in UNITS.items() if abs(size / meters - 1) < 1e-6]
            questions.append(f"is {whose} {named[0]}?" if named else "are they and the surface in one unit?")
        if not torch.equal(self.axes, torch.eye(3, dtype=torch.float64)):
            steps.append(f"with (x, y, z) taken as {_written(self.axes)}")
            mirrored = float(torch.linalg.det(self.axes)) < 0
            questions.append("are the axes mirrored?" if mirrored else "does another axis point up?")
        if self.shift.any():
            steps.append(f"moved by ({', '.join(f'{value:.3g}' for value in self.shift.tolist())}) m")
            questions.append("do the origins differ?")
        undone = ", ".join(steps) + "," * (len(steps) > 1)
        return f"{undone} they lie within {_length(self.distance)} of it: {' '.join(questions)}"


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
        if self.mistake is None or self.mistake.factor == 1:
            return False
        return self.mostly_off or (self.shrunken and len(self.distances) >= LEAST_CLOSE)

    @property
    def mostly_off(self) -> bool:
        """Whether more contacts lie off the surface than are single mistakes."""
        return len(self.off) > max(1, WRONG_ROWS * len(self.distances))

    @cached_property
    def off(self) -> tuple[int, ...]:
        """Rows of the contacts off the surface, the farthest first."""
        rows = torch.argsort(self.distances, descending=True)
        return tuple(row for row in rows.tolist() if float(self.distances[row]) > self.tolerance)

    def describe(self, names: Sequence[str] = ()) -> str:
        """Return a message on the contacts off the surface, by these names or else by indices; "" for none."""
        if self.on_surface:
            return ""
        if self.off:
            farthest = float(self.distances.max())
            few = self.mistake is None and 2 * len(self.off) < len(self.distances) and not self.shrunken
            which = f"{len(self.off)} of {len(self.distances)} contacts lie" if few else "the contacts lie"
            relative = _ratio(farthest / self.diagonal)
            found = f"{which} up to {_length(farthest)} ({relative} object diagonals) off the surface"
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
            f"{found}, and no change of unit, axes or origin explains it; give both in one frame (structure from "
            "motion chooses its own: see `align_similarity`)"
        )


def judge_placement(contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"]) -> Placement:
    """Measure how far contacts lie from a surface given by its points, and seek the mistake where most lie off it.

    Tried are the ratios of usual units, all 48 signed permutations of the axes, a shift, and these together. A mistake
    is reported where undoing it brings nine of ten contacts within half the tolerance and all of them on average `GAIN`
    times nearer in relation to their extent: the simplest of those that do about as well. Few contacts fit much by
    chance: axes are tried from five on, shifts from eight. Raises CaptureError where there are no contacts, or points
    without an extent.
    """
    places, cloud = contacts.double().numpy(), points.double().numpy()
    if not len(places) or not len(cloud) or not (np.isfinite(places).all() and np.isfinite(cloud).all()):
        name = "contacts" if not len(places) or not np.isfinite(places).all() else "points"
        count = len(places) if name == "contacts" else len(cloud)
        raise CaptureError(f"expected {name} with finite coordinates, got {count}", name=name, value=count)
    diagonal = _diagonal(cloud)
    if not diagonal > 0:
        raise CaptureError(
            f"expected points of an object with an extent, got {len(cloud)} at one position",
            name="points",
            value=diagonal,
        )
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
    small = 0 < placement.spread < SMALL_SPREAD * diagonal
    if not small and not placement.mostly_off:
        return placement
    search = _Search(cKDTree(some), _some(places, MOST_CONTACTS), placement)
    return replace(placement, mistake=search.find())


def expect_placed(
    contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"], *, names: Sequence[str] = ()
) -> None:
    """Raise FitError where contacts are not on a surface, with the transform that would bring them onto it.

    `points` are all over the surface, as `surface_points` has them; both in meters. Contacts are not on it where a
    mistake made with all of them explains that, of unit, axes or origin, and where half of them lie farther off than
    `Placement.tolerance`: rough surfaces, glue and single wrong rows pass. `names` are for the message.
    """
    placement = judge_placement(contacts, points)
    if placement.mistake is None and float(placement.distances.median()) <= placement.tolerance:
        return
    if placement.mistake is None:
        advice = "; bring both into one frame, or use a gain model without elastic mode shapes"
    elif placement.mistake.unit_only:
        advice = " State both units, as unit and surface_unit in capture.toml do, or give both in meters"
    else:
        advice = " Undo this in one of the two, or use a gain model without elastic mode shapes"
    raise FitError(
        f"expected contacts on the surface for elastic mode shapes, but {placement.describe(names)}{advice}",
        name="contacts",
        value=float(placement.distances.max()),
    )


def surface_points(surface: Surface, *, count: int = MOST_POINTS) -> Float[Tensor, "points 3"]:
    """Return points all over a surface, always the same: `count` on its triangles, evenly by area, and its vertices."""
    vertices = surface.vertices.double()
    if not len(surface.faces):
        return vertices
    mesh = trimesh.Trimesh(vertices.numpy(), surface.faces.numpy(), process=False)
    if not mesh.area > 0:
        return vertices
    return torch.cat([torch.from_numpy(np.array(trimesh.sample.sample_surface(mesh, count, seed=0)[0])), vertices])


class _Search:
    """The mistakes that are tried, each with a price for how much it explains away."""

    def __init__(self, tree: cKDTree, contacts: np.ndarray, placement: Placement) -> None:
        self.tree, self.contacts, self.placement = tree, contacts, placement
        cloud = np.asarray(tree.data)
        self.middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2

    def find(self) -> Mistake | None:
        """Return the cheapest mistake that explains the contacts well, if there is one."""
        found: list[tuple[float, Mistake]] = []
        for price, mistake in self._unmoved():
            self._weigh(price, mistake, found)
        if len(self.contacts) >= 8:
            # A shift can be fitted to anything, so that it has to explain a good deal more.
            for price, mistake in self._moved():
                self._weigh(3 * price, mistake, found)
        return min(found, key=lambda pair: pair[0])[1] if found else None

    def _unmoved(self) -> Iterator[tuple[float, Mistake]]:
        """Yield the ratios of units and the axes that give contacts of about the object's size."""
        spread, diagonal = self.placement.spread, self.placement.diagonal
        for factor in FACTORS:
            if spread and factor != 1 and not LEAST_SPREAD * diagonal <= factor * spread <= 1.2 * diagonal:
                continue
            for price, axes in _ways() if len(self.contacts) >= 5 else _ways()[:1]:
                yield price * (1 if factor == 1 else 1.5), Mistake(factor, axes, torch.zeros(3, dtype=torch.float64))

    def _moved(self) -> list[tuple[float, Mistake]]:
        """Return the likeliest of these with a shift, which starts between the middles and moves on to rest."""
        starts = []
        for price, mistake in self._unmoved():
            places = mistake.undo(torch.from_numpy(self.contacts)).numpy()
            shift = self.middle - (places.min(axis=0) + places.max(axis=0)) / 2
            starts.append((price * self.tree.query(places + shift)[0].mean(), price, mistake, places, shift))
        starts.sort(key=lambda start: start[0])
        moved = []
        for _, price, mistake, places, shift in starts[:12]:
            for _ in range(20):
                nearest = self.tree.query(places + shift)[1]
                shift = (np.asarray(self.tree.data)[nearest] - places).mean(axis=0)
            moved.append((price, replace(mistake, shift=torch.from_numpy(shift))))
        return moved

    def _weigh(self, price: float, mistake: Mistake, found: list[tuple[float, Mistake]]) -> None:
        """Add the mistake with its price times its mean distance to `found`, if it explains the contacts."""
        distances = self.tree.query(mistake.undo(torch.from_numpy(self.contacts)).numpy())[0]
        far, mean = float(np.quantile(distances, 0.9)), float(distances.mean())
        # Beside the size that the contacts have by then: what is shrunk comes nearer to anything.
        if far > min(0.5 * self.placement.tolerance, TOLERANCE * (mistake.factor * self.placement.spread or math.inf)):
            return
        if mean * GAIN > float(self.placement.distances.mean()) * mistake.factor:
            return
        # Differences below a two-hundredth of the object say nothing: points are no surface, nor contacts exact.
        cost = price * max(mean, self.placement.diagonal / 200) / mistake.factor
        found.append((cost, replace(mistake, distance=far)))


def _ways() -> list[tuple[float, Tensor]]:
    """Return the 48 signed permutations with a price each: none, y-up for z-up or back, other turns, mirrors."""
    ways = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = torch.diag(torch.tensor(signs, dtype=torch.float64)) @ torch.eye(3, dtype=torch.float64)[list(order)]
            price = 2.0 if float(torch.linalg.det(axes)) > 0 else 2.5
            if (order, signs) == ((0, 1, 2), (1, 1, 1)):
                price = 1.0
            elif (order, signs) in (((0, 2, 1), (1, -1, 1)), ((0, 2, 1), (1, 1, -1))):
                price = 1.5
            ways.append((price, axes))
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
