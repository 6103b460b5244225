"""Kernel families without a body: unstructured, smooth and thin plate in positions, and visual in features.

A family states one assumption about how gains vary over an object. Its kernels are weighted sums of a basis between
impacts, each times the cosine between their directions.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from avmsf.capture.impacts import places_of
from avmsf.mesh.points import nearest_points

LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Lengths of the smooth kernels over the object's size, the diagonal of the box around it."""
AFFINE_SHARES = (0.5, 0.9)
"""Shares of an affine function of the position in its sum with a smooth one."""
DRIFT_SHARES = (0.3, 0.7, 0.95)
"""Shares of the thin plate's affine part."""
FEATURE_LENGTHS = (0.25, 0.5, 1.0)
"""Lengths of the visual kernels over the root mean square distance between the features of points."""
VISUAL_LENGTHS = (0.2, 0.4, 0.8)
"""Lengths over the object's size of the positions' kernels that multiply the visual ones."""
_MEMORY = 4_000_000
"""Numbers of a basis held at once."""
_BLOCK = 32
"""Impacts whose basis among each other is computed for its diagonal."""
_ROUNDING = 1e-6
"""Distance over the object's size up to which float32 and a change of scale may move a point."""
_FLAT = 1e-3
"""Extent over the longest below which contacts do not differ along an axis."""

_SAME_DIRECTION = 0.9
"""Least cosine of directions, 26 degrees apart, whose impacts at one place are repetitions: hands do not aim better."""
_PERPENDICULAR = 1e-6
"""Largest cosine that the rounding of float32 (6e-8 a component) can leave between perpendicular directions. It has no
sign."""


@dataclass(frozen=True, eq=False)
class Sites:
    """Impacts: where, and along which direction."""

    points: Float64[Tensor, "sites 3"]
    """Object frame, meters."""
    directions: Float64[Tensor, "sites 3"]
    """Unit vectors along which the hammer moves; the same for all where nothing is known of them."""

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: Int[Tensor, " rows"]) -> "Sites":
        """Return some of the impacts."""
        return Sites(self.points[rows], self.directions[rows])

    def repetitions(self) -> Int[Tensor, " sites"]:
        """Return a number for each impact, the same for those at one place (`places_of`) along one direction."""
        owner = places_of(self.points)
        same = (owner[:, None] == owner) & (self.directions @ self.directions.T > _SAME_DIRECTION)
        return same.int().argmax(1)

    @classmethod
    def along(
        cls,
        points: Float64[Tensor, "sites 3"],
        directions: Float[Tensor, "sites 3"] | None,
        otherwise: Callable[[Float64[Tensor, "unknown 3"]], Float64[Tensor, "unknown 3"]],
    ) -> "Sites":
        """Return impacts at points; `otherwise` gives the directions that are not known, None or of length zero."""
        given = torch.zeros_like(points) if directions is None else directions.double()
        length = given.norm(dim=1, keepdim=True)
        unknown = ~(length[:, 0] > 0)
        used = given / length.clamp_min(torch.finfo(torch.float64).tiny)
        if bool(unknown.any()):
            used[unknown] = otherwise(points[unknown])
        return cls(points, used)

    @classmethod
    def joined(cls, parts: Sequence["Sites"]) -> "Sites":
        """Return the impacts of all parts, in their order."""
        return cls(torch.cat([each.points for each in parts]), torch.cat([each.directions for each in parts]))

    def cosine(self, other: "Sites") -> Float64[Tensor, "sites others"]:
        """Return the cosines between directions.

        A force along n sets a mode in motion by n . u, where u is the mode's displacement. If the components of u are
        independent of each other and alike, the covariance of two gains is that of a component times the cosine:
        perpendicular impacts say nothing of each other, and an opposite one changes the gain's sign.
        """
        return self.directions @ other.directions.T

    def nearest(
        self, others: "Sites", *, size: float, count: int, excluded: Bool[Tensor, "sites others"] | None = None
    ) -> tuple[Int[Tensor, "sites near"], Float64[Tensor, "sites near"]]:
        """Return the rows of the nearest of other impacts, at most `count`, none that is excluded, and each one's sign.

        With c the cosine between two directions the squared distance is that of the points plus (size / 2)^2 (1 - |c|):
        a perpendicular impact counts as half the object away, for it excites modes in other proportions, as an impact
        elsewhere does. The sign is that of c: a linear object answers an opposite force with the negated sound.
        """
        cosine = self.cosine(others)
        squares = (self.points[:, None] - others.points).square().sum(2) + (size / 2.0) ** 2 * (1.0 - cosine.abs())
        usable = len(others)
        if excluded is not None:
            squares, usable = squares.masked_fill(excluded, torch.inf), usable - int(excluded.sum(1).max())
        rows = squares.argsort(dim=1, stable=True)[:, : min(count, usable)]
        return rows, torch.where(cosine.gather(1, rows) < -_PERPENDICULAR, -1.0, 1.0).double()


Family = TypeVar("Family", bound="KernelFamily")


class KernelFamily:
    """Kernels of one assumption about how gains vary over an object.

    Kernel h between two impacts is sum_b shares[h, b] basis_b, scaled so that its mean over the reference impacts is
    one on the diagonal.
    """

    kind: ClassVar[str]
    """Its name in files, reports and settings."""
    prior: ClassVar[float] = 1.0
    """Probability of all kernels of the family together, over another family's."""

    reference: Sites
    """The impacts that scales and regressions are defined by: those of the fit."""
    size: float
    """Diagonal of the box around the object, meters."""
    shares: Float64[Tensor, "kernels basis"]
    """Scaled."""
    _rows: Int[Tensor, " kernels"] | None = None

    def __init__(self, reference: Sites, size: float) -> None:
        self.reference, self.size = reference, size

    def __len__(self) -> int:
        return len(self.shares)

    def take(self: Family, rows: Int[Tensor, " rows"]) -> Family:
        """Return the family of some of the kernels, which have no prior of their own any more."""
        found = copy(self)
        found.shares, found._rows = self.shares[rows], self.kept[rows]
        return found

    @property
    def kept(self) -> Int[Tensor, " kernels"]:
        """Which of all kernels of the family these are, as `take` chose them."""
        return torch.arange(len(self)) if self._rows is None else self._rows

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the basis between two sets of impacts; without one, a family has its own `diagonal` and `between`."""
        raise NotImplementedError

    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return the basis of each impact with itself."""
        parts = (sites.take(rows) for rows in torch.split(torch.arange(len(sites)), _BLOCK))
        return torch.cat([torch.diagonal(self.basis(part, part), dim1=1, dim2=2) for part in parts], dim=1)

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return the category of each kernel, from 0 on; each kernel is one, unless a family says otherwise."""
        return torch.arange(len(self))

    def category_prior(self) -> Float64[Tensor, " categories"]:
        """Return the probability of each category within the family; equal ones, unless a family says otherwise."""
        count = int(self.categories().max()) + 1
        return torch.full((count,), 1.0 / count, dtype=torch.float64)

    def visibility(self) -> Float64[Tensor, " kernels"]:
        """Return the mean square of gains at the reference impacts over that of a typical kernel of the family."""
        return torch.ones(len(self), dtype=torch.float64)

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability of each kernel within its category for modes of these log frequencies (Hz).

        It may be relative to the density of a measured log frequency under families that know nothing of it.
        """
        return torch.zeros(len(self), len(log_frequency), dtype=torch.float64)

    def kernels(self) -> Float64[Tensor, "kernels contacts contacts"]:
        """Return the kernels among the reference impacts."""
        return self.between(self.reference, self.reference)

    def between(self, sites: Sites, others: Sites) -> Float64[Tensor, "kernels sites others"]:
        """Return the kernels between two sets of impacts."""
        size = max(1, _MEMORY // max(1, self.shares.shape[1] * len(others)))
        rows = torch.split(torch.arange(len(sites)), size)
        parts = [sites] if len(rows) == 1 else [sites.take(each) for each in rows]
        return torch.cat([torch.einsum("hb,bso->hso", self.shares, self.basis(part, others)) for part in parts], dim=1)

    def own(self, sites: Sites) -> Float64[Tensor, "kernels sites"]:
        """Return the kernels of each impact with itself."""
        return self.shares @ self.diagonal(sites)


def scaled(
    shares: Float64[Tensor, "kernels basis"], diagonal: Float64[Tensor, "basis contacts"]
) -> Float64[Tensor, "kernels basis"]:
    """Return the shares over the kernels' mean on the diagonal, `diagonal` being the basis's there; zero stays."""
    size = shares @ diagonal.mean(1)
    return shares / torch.where(size > torch.finfo(torch.float64).tiny, size, 1.0)[:, None]


def squared_exponential(
    points: Float64[Tensor, "sites dim"], others: Float64[Tensor, "others dim"], lengths: Float64[Tensor, " lengths"]
) -> Float64[Tensor, "lengths sites others"]:
    """Return exp(-distance^2 / 2 length^2) for each length, in the points' unit."""
    # Not the default, whose shortcut through products loses half the digits of short distances.
    distance = torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-0.5 * (distance / lengths[:, None, None]).square())


class Unstructured(KernelFamily):
    """Gains that are independent from place to place, and gains that are the same everywhere.

    With the first, predictions shrink towards silence; without it a mode that is noise alone would be interpolated.
    """

    kind: ClassVar[str] = "unstructured"
    prior: ClassVar[float] = 0.05

    def __init__(self, reference: Sites, size: float) -> None:
        super().__init__(reference, size)
        self.shares = torch.eye(2, dtype=torch.float64)

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return one for impacts at the same point, but for rounding, and zero for others; and a constant."""
        squares = (sites.points[:, None] - others.points).square().sum(2)
        same = (squares <= (_ROUNDING * self.size) ** 2).double()
        return torch.stack([same, torch.ones_like(same)]) * sites.cosine(others)


class Smooth(KernelFamily):
    """Squared exponential kernels of several lengths, by themselves and added to an affine function of the position."""

    kind: ClassVar[str] = "smooth"

    def __init__(self, reference: Sites, size: float) -> None:
        super().__init__(reference, size)
        self._axes, self._lengths = Axes(reference.points), size * torch.tensor(LENGTHS, dtype=torch.float64)
        alone = torch.eye(len(LENGTHS), dtype=torch.float64)
        affine = torch.tensor(AFFINE_SHARES, dtype=torch.float64)
        # The shortest is left out there: what is not affine would be noise.
        added = (1.0 - affine)[:, None, None] * alone[1:]
        both = torch.cat([added, affine[:, None, None].expand(*added.shape[:2], 1)], dim=2).flatten(0, 1)
        shares = torch.cat([torch.nn.functional.pad(alone, (0, 1)), both])
        self.shares = scaled(shares, self.diagonal(reference))

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the squared exponentials and the affine kernel (1 + x . x') / (1 + dim), x standardized."""
        smooth = squared_exponential(sites.points, others.points, self._lengths)
        one, other = (self._axes.standardized(each.points) for each in (sites, others))
        affine = (1.0 + one @ other.T) / (1.0 + one.shape[1])
        return torch.cat([smooth, affine[None]]) * sites.cosine(others)


class ThinPlate(KernelFamily):
    """The thin-plate spline as a Gaussian process: a function of least bending added to an affine one.

    The kernel k = r^2 log r is positive definite but for affine functions. With H(x) = p(x) P^+, p = (1, x) and P its
    rows at the contacts, K = k - k H' - H k + H k H' is the covariance of what k has beyond its affine regression on
    the contacts (kriging with a drift; Wahba, Spline Models for Observational Data, 1990, section 2.4), and H H' that
    of the affine part. With fewer contacts than twice the number of coefficients of an affine function it is the
    distance kernel -r and a constant, which do not run away beyond the contacts.
    """

    kind: ClassVar[str] = "thin-plate"

    def __init__(self, reference: Sites, size: float) -> None:
        super().__init__(reference, size)
        self._axes = Axes(reference.points)
        along = self._axes.along(reference.points)
        places = len(torch.unique(reference.points, dim=0))
        self._bending = places >= 2 * (along.shape[1] + 1)
        self._inverse = torch.linalg.pinv(self._drift(along))
        self._among = self._kernel(along, along)
        drift = torch.tensor(DRIFT_SHARES, dtype=torch.float64)
        # Each part is of mean one on the diagonal before the shares are taken; with one place, nothing bends.
        diagonal = self.diagonal(reference)
        size_of = torch.where(diagonal.mean(1) > torch.finfo(torch.float64).tiny, diagonal.mean(1), torch.inf)
        self.shares = scaled(torch.stack([1.0 - drift, drift], dim=1) / size_of, diagonal)

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the kernel of what bends, and that of the affine part."""
        one, other, known = (self._axes.along(each.points) for each in (sites, others, self.reference))
        left, right = self._drift(one) @ self._inverse, self._drift(other) @ self._inverse
        bent = self._kernel(one, other) - left @ self._kernel(known, other) - self._kernel(one, known) @ right.T
        return torch.stack([bent + left @ self._among @ right.T, left @ right.T]) * sites.cosine(others)

    def _kernel(
        self, along: Float64[Tensor, "sites dim"], others: Float64[Tensor, "others dim"]
    ) -> Float64[Tensor, "sites others"]:
        # Not cdist, whose shortcut through products loses half the digits of short distances.
        distance = (along[:, None] - others).square().sum(2).sqrt()
        return torch.special.xlogy(distance.square(), distance) if self._bending else -distance

    def _drift(self, along: Float64[Tensor, "sites dim"]) -> Float64[Tensor, "sites terms"]:
        constant = torch.ones(len(along), 1, dtype=torch.float64)
        return torch.cat([constant, along], dim=1) if self._bending else constant


POSITIONAL: dict[str, type[KernelFamily]] = {each.kind: each for each in (Unstructured, Smooth, ThinPlate)}
"""Families that need nothing but the contacts, by name."""


class Axes:
    """Principal axes of contacts, those along which they differ."""

    def __init__(self, points: Float64[Tensor, "contacts 3"]) -> None:
        self._middle = points.mean(0)
        centered = points - self._middle
        _, _, rows = torch.linalg.svd(centered, full_matrices=False)
        along = centered @ rows.T
        extent = along.amax(0) - along.amin(0)
        longest = float(extent.max()) or 1.0
        kept = extent > _FLAT * longest
        self._directions = rows[kept].T / longest
        self._deviation = along[:, kept].square().mean(0).sqrt() / longest

    def along(self, points: Float64[Tensor, "sites 3"]) -> Float64[Tensor, "sites dim"]:
        """Return points along the axes, over the contacts' longest extent."""
        return (points - self._middle) @ self._directions

    def standardized(self, points: Float64[Tensor, "sites 3"]) -> Float64[Tensor, "sites dim"]:
        """Return points along the axes, of mean square one over the contacts along each."""
        return self.along(points) / self._deviation


class Visual(KernelFamily):
    """Squared exponential kernels in the distance between features, by themselves and times those of positions.

    An impact has the features of the nearest point of the object.
    """

    kind: ClassVar[str] = "visual"

    def __init__(
        self,
        reference: Sites,
        size: float,
        points: Float32[Tensor, "points 3"],
        features: Float32[Tensor, "points dim"],
    ) -> None:
        """Set up from an object's points, meters, and their features, in any unit."""
        super().__init__(reference, size)
        self.points, self.features = points, features
        spread = features.double().var(0, correction=0).sum()
        self._unit = float((2.0 * spread).sqrt()) or 1.0
        self._feature_lengths = torch.tensor(FEATURE_LENGTHS, dtype=torch.float64)
        self._lengths = size * torch.tensor(VISUAL_LENGTHS, dtype=torch.float64)
        self.shares = torch.eye(len(FEATURE_LENGTHS) * (1 + len(VISUAL_LENGTHS)), dtype=torch.float64)

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the features' kernels, then their products with each of the positions'."""
        one, other = self._features_at(sites), self._features_at(others)
        similar = squared_exponential(one, other, self._feature_lengths) * sites.cosine(others)
        near = squared_exponential(sites.points, others.points, self._lengths)
        return torch.cat([similar, (near[:, None] * similar).flatten(0, 1)])

    def _features_at(self, sites: Sites) -> Float64[Tensor, "sites dim"]:
        return self.features[nearest_points(self.points, sites.points)[:, 0]].double() / self._unit
