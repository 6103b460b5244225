"""What every kernel family is: kernels that are weighted sums of a basis, among contacts and to other places."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

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

    def cosine(self, other: "Sites") -> Float64[Tensor, "sites others"]:
        """Return the cosines between directions.

        A force along n sets a mode in motion by n . u, where u is the mode's displacement. If the components of u are
        independent of each other and alike, the covariance of two gains is that of a component times the cosine:
        perpendicular impacts say nothing of each other, and an opposite one changes the gain's sign.
        """
        return self.directions @ other.directions.T


def sites_along(
    points: Float64[Tensor, "sites 3"],
    directions: Float[Tensor, "sites 3"] | None,
    otherwise: Callable[[Float64[Tensor, "unknown 3"]], Float64[Tensor, "unknown 3"]],
) -> Sites:
    """Return impacts at points; `otherwise` gives the directions where they are not known, None or of length zero."""
    given = torch.zeros_like(points) if directions is None else directions.double()
    length = given.norm(dim=1, keepdim=True)
    unknown = ~(length[:, 0] > 0)
    used = given / length.clamp_min(torch.finfo(torch.float64).tiny)
    if bool(unknown.any()):
        used[unknown] = otherwise(points[unknown])
    return Sites(points, used)


def nearest_sites(
    sites: Sites, others: Sites, *, size: float, count: int, excluded: Bool[Tensor, "sites others"] | None = None
) -> tuple[Int[Tensor, "sites near"], Float64[Tensor, "sites near"]]:
    """Return the rows of the nearest impacts, at most `count` and none that is excluded, and the sign of each.

    With c the cosine between two directions the squared distance is that of the points plus (size / 2)^2 (1 - |c|): a
    perpendicular impact counts as half the object away, for it excites modes in other proportions, as an impact
    elsewhere does. The sign is that of c: a linear object answers an opposite force with the negated sound.
    """
    cosine = sites.cosine(others)
    squares = (sites.points[:, None] - others.points).square().sum(2) + (size / 2.0) ** 2 * (1.0 - cosine.abs())
    usable = len(others)
    if excluded is not None:
        squares, usable = squares.masked_fill(excluded, torch.inf), usable - int(excluded.sum(1).max())
    rows = squares.argsort(dim=1, stable=True)[:, : min(count, usable)]
    return rows, torch.where(cosine.gather(1, rows) < -_PERPENDICULAR, -1.0, 1.0).double()


class KernelFamily(ABC):
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

    def __init__(self, reference: Sites, size: float) -> None:
        self.reference, self.size = reference, size

    @abstractmethod
    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the basis between two sets of impacts."""

    @abstractmethod
    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return the basis of each impact with itself."""

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return the category of each kernel, from 0 on; each kernel is one, unless a family says otherwise."""
        return torch.arange(len(self.shares))

    def category_prior(self) -> Float64[Tensor, " categories"]:
        """Return the probability of each category within the family; equal ones, unless a family says otherwise."""
        count = int(self.categories().max()) + 1
        return torch.full((count,), 1.0 / count, dtype=torch.float64)

    def visibility(self) -> Float64[Tensor, " kernels"]:
        """Return the mean square of gains at the reference impacts over that of a typical kernel of the family."""
        return torch.ones(len(self.shares), dtype=torch.float64)

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability of each kernel within its category for modes of these log frequencies (Hz).

        It may be relative to the density of a measured log frequency under families that know nothing of it.
        """
        return torch.zeros(len(self.shares), len(log_frequency), dtype=torch.float64)

    def kernels(self) -> Float64[Tensor, "kernels contacts contacts"]:
        """Return all kernels among the reference impacts."""
        return self.between(self.reference, self.reference, torch.arange(len(self.shares)))

    def between(self, sites: Sites, others: Sites, kept: Int[Tensor, " kept"]) -> Float64[Tensor, "kept sites others"]:
        """Return some kernels between two sets of impacts."""
        return torch.einsum("hb,bso->hso", self.shares[kept], self.basis(sites, others))

    def factors(self, sites: Sites, known: Sites) -> Float64[Tensor, "sites factors"]:
        """Return vectors z of impacts for which each kernel's covariances with the known ones are `loadings` times z.

        Here the basis with each known impact.
        """
        return self.basis(sites, known).permute(1, 2, 0).flatten(1)

    def loadings(self, known: Sites, kept: Int[Tensor, " kept"]) -> Float64[Tensor, "kept known factors"]:
        """Return the matrix of each of some kernels that gives covariances with known impacts from `factors`."""
        one = torch.eye(len(known), dtype=torch.float64)
        return (one[:, :, None] * self.shares[kept][:, None, None]).flatten(2)

    def own(self, sites: Sites, kept: Int[Tensor, " kept"]) -> Float64[Tensor, "kept sites"]:
        """Return some kernels of each impact with itself."""
        return self.shares[kept] @ self.diagonal(sites)

    def coefficients(
        self, kept: Int[Tensor, " kept"], solved: Float64[Tensor, "kept contacts series"]
    ) -> Float64[Tensor, "basis contacts series"]:
        """Return the coefficients of the basis in the means, from those of the kernels (`KernelMixture.solve`)."""
        return torch.einsum("hb,hcs->bcs", self.shares[kept], solved)

    def mean(
        self, sites: Sites, known: Sites, coefficients: Float64[Tensor, "basis contacts series"]
    ) -> Float64[Tensor, "sites series"]:
        """Return the family's part of the means at impacts, whose coefficients are those of the known impacts."""
        return torch.einsum("bpc,bcs->ps", self.basis(sites, known), coefficients)


Family = TypeVar("Family", bound=KernelFamily)


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
