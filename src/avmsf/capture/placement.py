"""Whether contacts lie on the object's surface, and where they do not, the similarity that brings them onto it.

Candidates are ratios of usual units or any scale, all 48 signed permutations of the axes, and a shift; what is not
discrete is fitted by iterated closest points (Besl and McKay, 1992). They are compared by description length (Rissanen,
1978): nats of the parameters and of the distances that are left.
"""

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.text import listed
from avmsf.capture.settings import unit_named
from avmsf.errors import CaptureError, CaptureWarning, FitError
from avmsf.mesh.surface import MOST_POINTS

TOLERANCE = 0.05
"""Distance from the surface, over the object's diagonal, up to which a contact lies on it.

On the aircraft, measured by hand against a nominal surface, the farthest of 74 contacts lies .004 off.
"""
WRONG_ROWS = 0.1
"""Part of the contacts up to which those that lie off count as single mistakes, not as one made with all of them."""
FACTORS = (1.0, *(power for size in (1000.0, 100.0, 10.0, 25.4, 0.0254, 0.3048) for power in (size, 1 / size)))
"""Ratios of units that one of the two may count by mistake."""


@dataclass(frozen=True)
class _Bounds:
    """Bounds of the comparison; lengths are over the object's diagonal."""

    spot: float = 0.05  # diagonal of the contacts below which their unit must be another
    spot_contacts: int = 5  # from which on a small spread alone shows that
    least_spread: float = 0.4  # diagonal that another scale must leave: what is shrunk enough fits anywhere
    most_spread: float = 1.2  # diagonal that it may leave
    resolution: float = 1 / 200  # distance below which contacts lie equally well: they are not exact
    log_size: float = 0.25  # logarithm of a scale beyond which it is another object's: no material explains that
    outlier_nats: float = 3.0  # of a contact that is a mistake of its own, as one of twenty is
    axes_contacts: int = 5  # from which on axes are tried
    fit_contacts: int = 8  # from which on scales and shifts are fitted: fewer fit much by chance
    max_contacts: int = 200  # that are compared, evenly taken from all
    max_starts: int = 24
    max_steps: int = 60


_BOUNDS = _Bounds()


@dataclass(frozen=True, eq=False)
class FrameMismatch:
    """What may have been done to all contacts, by how it is undone: x becomes `factor` * `axes` x + `shift`."""

    factor: float = 1.0
    axes: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """A permutation with signs."""
    shift: Float64[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))
    """Meters."""
    distance: float = 0.0
    """Meters within which nine of ten contacts lie off the surface once it is undone."""

    def undo(self, contacts: Float64[np.ndarray, "contacts 3"]) -> Float64[np.ndarray, "contacts 3"]:
        """Return where the contacts were meant."""
        return self.factor * contacts @ self.axes.T + self.shift

    @property
    def turned(self) -> bool:
        """Whether the axes are others, or mirrored."""
        return not np.array_equal(self.axes, np.eye(3))

    @property
    def unit_only(self) -> bool:
        """Whether the unit alone is wrong."""
        return not self.turned and not self.shift.any()

    @property
    def unit(self) -> str | None:
        """Name of the unit that one of the two counts by mistake; None for another factor."""
        return None if self.factor == 1 else unit_named(min(self.factor, 1 / self.factor))

    def __str__(self) -> str:
        within, steps = f"they lie within {_length(self.distance)} of it", []
        if self.factor != 1:
            whose = "the surface's" if self.factor > 1 else "their"
            unit = f' (is {whose} unit "{self.unit}"?)' if self.unit else ""
            steps.append(f"multiplied by {self.factor:.4g}{unit}")
        if self.turned:
            names = ["-" * bool(row.min() < 0) + "xyz"[int(np.abs(row).argmax())] for row in self.axes]
            mirrored = " (are they mirrored?)" if np.linalg.det(self.axes) < 0 else ""
            steps.append(f"with (x, y, z) taken as ({', '.join(names)}){mirrored}")
        if self.shift.any():
            steps.append(f"moved by ({', '.join(f'{value:.3g}' for value in self.shift)}) m")
        return f"{', '.join(steps)}, {within}"


@dataclass(frozen=True, eq=False)
class Placement:
    """How contacts lie to a surface."""

    distances: Float64[np.ndarray, " contacts"]
    """From each contact to the surface's nearest point, meters."""
    diagonal: float
    """Of the object's bounding box, meters."""
    spread: float
    """Diagonal of the contacts' bounding box, meters."""
    tolerance: float
    """Meters up to which a contact counts as on the surface: `TOLERANCE`, or more where the points are sparse."""
    mismatch: FrameMismatch | None = None
    """What would explain contacts off the surface; None where they lie on it, or nothing simple explains them."""

    @cached_property
    def off(self) -> tuple[int, ...]:
        """Rows of the contacts off the surface, the farthest first."""
        rows = np.argsort(-self.distances, kind="stable")
        return tuple(rows[self.distances[rows] > self.tolerance].tolist())

    @property
    def mostly_off(self) -> bool:
        """Whether more contacts lie off the surface than are single mistakes."""
        return len(self.off) > max(1, WRONG_ROWS * len(self.distances))

    @property
    def shrunken(self) -> bool:
        """Whether the contacts lie in a spot so small that their unit must be another."""
        return 0 < self.spread < _BOUNDS.spot * self.diagonal

    @property
    def fault(self) -> Literal["none", "rows", "frame", "unit"]:
        """How wrong the contacts lie: not at all, as single mistakes or by little, most of them, or by their unit.

        For "frame", which is turned, mirrored, of another size or has most contacts off, no shape can be used as it
        lies. For "unit" another one brings them onto the surface beyond doubt; where they lie on it already, as first
        impacts near the middle of a plate do, only many that are very close together say so.
        """
        mismatch, close = self.mismatch, self.shrunken and len(self.distances) >= _BOUNDS.spot_contacts
        if mismatch is not None and mismatch.unit is not None and (self.mostly_off or close):
            return "unit"
        resized = mismatch is not None and abs(math.log(mismatch.factor)) > _BOUNDS.log_size
        if mismatch is not None and (mismatch.turned or resized or self.mostly_off):
            return "frame"
        if float(np.median(self.distances)) > self.tolerance:
            return "frame"
        return "rows" if self.off or self.shrunken or mismatch is not None else "none"

    @property
    def apart(self) -> bool:
        """Whether contacts and points are in different frames or units."""
        return self.fault in ("frame", "unit")

    def describe(self, names: Sequence[str] = (), *, what: str = "surface") -> str:
        """Return a message on the contacts off `what` there is, by these names or else by indices; "" for none."""
        if self.fault == "none":
            return ""
        count, farthest = len(self.distances), float(self.distances.max())
        few = self.mismatch is None and 0 < 2 * len(self.off) < count
        which = f"{len(self.off)} of {count} contacts lie" if few else "the contacts lie"
        found = f"{which} up to {_length(farthest)} ({farthest / self.diagonal:.3g} object diagonals) off the {what}"
        if self.shrunken and not self.off:
            found = f"the contacts lie within {_length(self.spread)} on an object {_length(self.diagonal)} across"
        if self.mismatch is not None:
            return f"{found}; {self.mismatch}"
        if few:
            shown = listed([names[row] if names else f"row {row}" for row in self.off])
            return f"{found}, the others on it; check {shown}"
        if not self.off:
            return f"{found}: in a spot too small for impacts all over it; check that both are in one unit and frame"
        return (
            f"{found}, and no change of unit, axes or origin explains it: the {what} and the contacts are in different "
            "frames; give both in one (structure from motion chooses its own: see docs/visual-inputs.md; nerfstudio's "
            "moved the object as its dataparser_transforms.json says)"
        )


def check_placement(contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"]) -> Placement:
    """Measure how far contacts lie from a surface given by its points, and seek the similarity that explains them best.

    That of the least description length is reported unless it leaves the contacts where they are. Raises CaptureError
    where there are no contacts, or points without an extent.
    """
    places, cloud = contacts.double().numpy(), points.double().numpy()
    for name, values in (("contacts", places), ("points", cloud)):
        if not len(values) or not np.isfinite(values).all():
            raise CaptureError.expected(f"{name} with finite coordinates", len(values), name=name)
    diagonal = float(np.linalg.norm(np.ptp(cloud, axis=0)))
    if not diagonal > 0:
        got = f"{len(cloud)} at one position"
        raise CaptureError.expected("points of an object with an extent", diagonal, got=got, name="points")
    tree = cKDTree(cloud)
    # Between points that lie far apart, a contact on the surface is far from all of them.
    nearest = tree.query(_evenly(cloud, MOST_POINTS), k=[min(2, len(cloud))])[0]
    spacing = float(np.quantile(nearest, 0.95))
    placement = Placement(
        distances=tree.query(places)[0],
        diagonal=diagonal,
        spread=float(np.linalg.norm(np.ptp(places, axis=0))),
        tolerance=max(TOLERANCE * diagonal, 2 * spacing),
    )
    some, resolution = _evenly(places, _BOUNDS.max_contacts), max(spacing, _BOUNDS.resolution * diagonal)
    return replace(placement, mismatch=_find_mismatch(tree, some, placement, resolution))


def expect_placed(
    contacts: Float[Tensor, "contacts 3"],
    points: Float[Tensor, "points 3"],
    *,
    names: Sequence[str] = (),
    what: str = "surface",
    strict: bool = False,
    advice: str = "",
) -> None:
    """Raise CaptureError for contacts in another frame or unit than an object's points, and warn of others off these.

    `points` are all over `what` there is; both in meters. CaptureError too for a contact farther off than the object is
    large, and if `strict` for any off it. The `value` is the largest distance, meters.
    """
    placement = check_placement(contacts, points)
    words, distance = placement.describe(names, what=what), float(placement.distances.max())
    if not words:
        return
    if placement.apart or distance > placement.diagonal or (strict and placement.off):
        raise CaptureError(f"{words}{advice}", name="contacts", value=distance)
    warnings.warn(CaptureWarning(words, name="contacts", value=distance), stacklevel=2)


def expect_on_body(
    contacts: Float[Tensor, "contacts 3"], points: Float[Tensor, "points 3"], *, names: Sequence[str]
) -> None:
    """Raise FitError where contacts are in another frame or unit than points all over a body; both in meters.

    Rough surfaces, glue, single wrong rows and small shifts pass (`Placement.fault`). The `value` is the largest
    distance, meters.
    """
    placement = check_placement(contacts, points)
    if placement.apart:
        wanted = "contacts on the surface for elastic mode shapes"
        advice = "bring both into one frame and unit (unit, surface_unit in capture.toml), or use another gain model"
        distance = float(placement.distances.max())
        raise FitError.expected(wanted, distance, got=placement.describe(names), name="contacts", advice=advice)


def _find_mismatch(
    tree: cKDTree, contacts: Float64[np.ndarray, "contacts 3"], placement: Placement, resolution: float
) -> FrameMismatch | None:
    """Return the similarity of the least description length; None where that changes nothing."""
    widest, tolerance = max(2 * resolution, float(placement.distances.max())), placement.tolerance
    steps = math.ceil(math.log(widest / resolution, 1.5)) + 1
    deviations = np.geomspace(resolution, widest, steps)[:, None]
    anywhere = math.log(max(placement.diagonal, placement.spread)) + _BOUNDS.outlier_nats

    def distances(mismatch: FrameMismatch) -> np.ndarray:
        return np.asarray(tree.query(mismatch.undo(contacts))[0])

    def nats(mismatch: FrameMismatch) -> float:
        # Each distance is normal, with a standard deviation chosen for the similarity, or the contact is a mistake of
        # its own and lies anywhere. Distances over the scale make what is shrunk no better than what it was, and
        # contacts within a spot of an object are as unlikely as the spot is small.
        if not mismatch.factor > 0:
            return math.inf
        left, scale = np.maximum(distances(mismatch), resolution), min(mismatch.factor, 1.0)
        near = np.square(left / deviations) / 2 + np.log(deviations / scale)
        spread = mismatch.factor * placement.spread or math.inf
        spot = max(0.0, math.log(max(_BOUNDS.spot * placement.diagonal / spread, 1.0)))
        return float(np.minimum(near, anywhere).sum(axis=1).min()) + len(left) * spot

    present = nats(FrameMismatch())
    if present - len(contacts) * (math.log(resolution) + 0.5) < 1:
        return None
    starts = sorted(_starts(tree.data, contacts, placement), key=lambda start: start[0] + nats(start[1]))
    fitted = [(start[0], _fit(tree, contacts, *start[1:])) for start in starts[: _BOUNDS.max_starts]]
    for total, each in sorted(((code + nats(each), each) for code, each in fitted), key=lambda pair: pair[0]):
        far = float(np.quantile(distances(each), 0.9))
        # Beside the size that the contacts have by then: what is shrunk comes nearer to anything.
        spread = each.factor * placement.spread or math.inf
        if total < present and far <= min(max(resolution, 0.5 * tolerance), TOLERANCE * spread):
            return replace(each, distance=far)
    return None


def _starts(
    points: Float64[np.ndarray, "points 3"], contacts: Float64[np.ndarray, "contacts 3"], placement: Placement
) -> Iterator[tuple[float, FrameMismatch, bool, bool]]:
    """Yield similarities, the nats of their parameters, and whether their scale and their shift are fitted."""
    spread, diagonal, count = placement.spread, placement.diagonal, len(contacts)
    least, most = _BOUNDS.least_spread * diagonal, _BOUNDS.most_spread * diagonal
    # What is symmetric but for errors of this size does not show which way it lies.
    off = float(placement.distances.max()) > placement.tolerance / 2
    fitting = (factor for factor in FACTORS if factor == 1 or not spread or least <= factor * spread <= most)
    scales, shifts = [(factor, False) for factor in fitting], [False]
    if count >= _BOUNDS.fit_contacts:
        ratio = diagonal / spread if spread else 1.0
        scales += [(factor, True) for factor in (1.0, 0.8 * ratio, ratio)]
        shifts = [False, True]
    middle, own = ((each.min(axis=0) + each.max(axis=0)) / 2 for each in (points, contacts))
    for rarity, axes in _signed_permutations() if off and count >= _BOUNDS.axes_contacts else [(1, np.eye(3))]:
        for (factor, scaled), shifted in itertools.product(scales, shifts):
            start = FrameMismatch(factor, axes, (middle - factor * axes @ own) * shifted)
            # Nothing in meters takes two units.
            units = 2 if scaled or (factor != 1 and start.unit is None) else int(factor != 1)
            nats = math.log(rarity) + units * math.log(len(FACTORS)) + (3 * shifted + scaled) * math.log(count)
            yield nats, start, scaled, shifted


def _fit(
    tree: cKDTree, contacts: Float64[np.ndarray, "contacts 3"], start: FrameMismatch, scaled: bool, shifted: bool
) -> FrameMismatch:
    """Return the similarity with the scale and the shift that iterated closest points find from a start."""
    found, source = start, contacts @ start.axes.T
    old = source.mean(axis=0) * shifted
    size = float(np.square(source - old).sum())
    for _ in range(_BOUNDS.max_steps if scaled or shifted else 0):
        target = tree.data[tree.query(found.undo(contacts))[1]]
        new = target.mean(axis=0) * shifted
        factor = float(((source - old) * (target - new)).sum()) / size if scaled and size else found.factor
        last, found = found, replace(found, factor=factor, shift=new - factor * old)
        if factor == last.factor and np.array_equal(found.shift, last.shift):
            break
    return found


def _signed_permutations() -> Iterator[tuple[int, Float64[np.ndarray, "3 3"]]]:
    """Yield the 48 signed permutations of the axes, each with how rare it is: none, y-up for z-up, turns, mirrors."""
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)):
        axes = np.diag(signs) @ np.eye(3)[list(order)]
        about_x = axes[0, 0] == 1 and axes.trace() == 1
        yield 48 if np.linalg.det(axes) < 0 else 1 if axes.trace() == 3 else 4 if about_x else 24, axes


def _evenly(places: np.ndarray, most: int) -> np.ndarray:
    return places[:: -(-len(places) // most)]


def _length(meters: float) -> str:
    return f"{meters * 1e3:.2g} mm" if meters < 0.01 else f"{meters:.3g} m"
