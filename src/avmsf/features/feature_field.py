"""What is known of every point of an object's surface, for the gain field to read."""

import hashlib
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf._utils.summary import short_repr
from avmsf.errors import FitError
from avmsf.gaussians.points import cluster, lattice, nearest_points, sample_surface
from avmsf.mesh.surface import Surface

GEOMETRY = "geometry"
"""The encoder's name where features are the points' own positions and normals: the paper's row without visual input."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Groups of neighboring points, each with one descriptor (paper, eq. 7)."""

    centers: Float[Tensor, "clusters 3"]
    """Means of the groups' points, meters."""
    descriptors: Float[Tensor, "clusters dim"]
    """Means of the groups' features."""


@dataclass(frozen=True, eq=False)
class FeatureField:
    """Points of an object, each with a feature vector."""

    __repr__ = short_repr

    points: Float[Tensor, "points 3"]
    """Object frame, meters."""
    features: Float[Tensor, "points dim"]
    """About unit size, so that no dimension drowns the others."""
    encoder: str
    """Who made the features; a field keeps it, so that it is never taken for another's."""
    on_surface: bool = True
    """Whether the points are on the object's surface; not if they only fill the box of its contacts."""

    @classmethod
    def from_mesh(
        cls, surface: Surface, *, seed: Seed = None, count: int = 8192, normal_scale: float = 0.0
    ) -> "FeatureField":
        """Return `count` points drawn evenly from a surface's triangles, with their positions as features.

        `normal_scale` adds their normals, of this length, to positions of about unit size. The two sides of a thin wall
        sound the same and have opposite normals, and a contact's nearest point may be on either side. So normals are
        left out by default. A surface of points alone keeps its points, which have no normals.
        """
        if len(surface.faces) == 0:
            return cls.from_points(surface.vertices)
        samples = sample_surface(surface.vertices, surface.faces, count, generator=generator_of(seed))
        return cls.from_points(
            samples.points, normals=samples.normals if normal_scale else None, normal_scale=normal_scale
        )

    @classmethod
    def from_points(
        cls,
        points: Float[Tensor, "points 3"],
        *,
        normals: Float[Tensor, "points 3"] | None = None,
        normal_scale: float = 1.0,
    ) -> "FeatureField":
        """Return the points with their positions, relative to the object's size, and their normals as features."""
        _expect_extent(points)
        middle = (points.amax(0) + points.amin(0)) / 2
        positions = (points - middle) / _half_diagonal(points)
        features = positions if normals is None else torch.cat([positions, normal_scale * normals], dim=1)
        return cls(points.float(), features.float(), GEOMETRY)

    @classmethod
    def from_contacts(cls, contacts: Float[Tensor, "contacts 3"], *, count: int = 8192) -> "FeatureField":
        """Return points that fill the contacts' bounding box, for an object of which nothing else is known."""
        _expect_extent(contacts)
        return replace(cls.from_points(lattice(contacts, count)), on_surface=False)

    @property
    def half_diagonal(self) -> float:
        """Half the diagonal of the points' bounding box, meters: the object's size in formulas."""
        return _half_diagonal(self.points)

    def digest(self) -> str:
        """Return a digest of the points, their features and who made them."""
        digest = hashlib.sha256(self.encoder.encode())
        for tensor in (self.points, self.features):
            digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def nearest(self, contacts: Float[Tensor, "contacts 3"]) -> Int[Tensor, " contacts"]:
        """Return the row of the point nearest to each contact (paper: i*, section 3.5)."""
        return nearest_points(self.points, contacts)[:, 0]

    def at(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts dim"]:
        """Return the features of the points nearest to the contacts."""
        return self.features[self.nearest(contacts)]

    def clusters(self, count: int) -> Regions:
        """Return `count` regions by k-means on the positions, with the mean feature of each (paper, eq. 7)."""
        groups = cluster(self.points, count)
        sums = self.features.new_zeros(count, self.features.shape[1]).index_add_(0, groups.labels, self.features)
        sizes = torch.bincount(groups.labels, minlength=count)
        return Regions(groups.centers.float(), sums / sizes[:, None])


def _half_diagonal(points: Float[Tensor, "points 3"]) -> float:
    return math.dist(points.amax(0).tolist(), points.amin(0).tolist()) / 2


def _expect_extent(points: Float[Tensor, "points 3"]) -> None:
    if len(points) == 0 or not bool(torch.isfinite(points).all()) or _half_diagonal(points) == 0.0:
        raise FitError(
            f"expected points that span an object, got {len(points)} at one position or not finite",
            name="points",
            value=len(points),
        )
