"""What is known of every point of an object's surface, as a gain field wants it: few numbers of about unit size.

As a file that is safetensors with `points` and `features`, and one JSON in the header for the rest.

{"format": 1, "version": "0.1.0", "encoder": "descriptors", "sizes": {"points": 8192, "dim": 36}, "report": {...}}
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.arrays import Seed, short_repr
from avmsf._utils.caching import content_digest
from avmsf._utils.headers import FEATURES_KEY, FileKind
from avmsf._utils.tensor_files import TensorReader, read_tensors, write_tensors
from avmsf.errors import FitError, SceneError
from avmsf.mesh.points import cluster, lattice, nearest_points
from avmsf.mesh.surface import Surface, sample_surface

GEOMETRY = "geometry"
"""The encoder's name where features are the points' own positions: the paper's row without visual input."""


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
    def from_mesh(cls, surface: Surface, *, seed: Seed = None, count: int = 8192) -> "FeatureField":
        """Return `count` points drawn evenly from a surface's triangles, with their positions as features.

        Normals are no features: the two sides of a thin wall sound the same and have opposite ones, and a contact's
        nearest point may be on either side. A surface of points alone keeps its points.
        """
        if len(surface.faces) == 0:
            return cls.from_points(surface.vertices)
        return cls.from_points(sample_surface(surface, count, seed=seed))

    @classmethod
    def from_points(cls, points: Float[Tensor, "points 3"]) -> "FeatureField":
        """Return the points with their positions, relative to the object's size, as features."""
        _expect_extent(points)
        middle = (points.amax(0) + points.amin(0)) / 2
        return cls(points.float(), ((points - middle) / _half_diagonal(points)).float(), GEOMETRY)

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
        return content_digest(self.encoder, self.points, self.features)

    def nearest(self, contacts: Float[Tensor, "contacts 3"]) -> Int[Tensor, " contacts"]:
        """Return the row of the point nearest to each contact (paper: i*, section 3.5)."""
        return nearest_points(self.points, contacts)[:, 0]

    def clusters(self, count: int) -> tuple[Float[Tensor, "clusters 3"], Float[Tensor, "clusters dim"]]:
        """Return the mean positions and features of `count` regions, by k-means on the positions (paper, eq. 7)."""
        centers, labels = cluster(self.points, count)
        sums = self.features.new_zeros(count, self.features.shape[1]).index_add_(0, labels, self.features)
        return centers.float(), sums / torch.bincount(labels, minlength=count)[:, None]


def reduce(features: FeatureField, dim: int) -> FeatureField:
    """Return the features' first `dim` principal components, with the encoder's name followed by what was done.

    Each has variance 1 over the points. A component's sign is that of its largest loading, so that the same features
    give the same components anywhere. Fewer come out where the features vary in fewer directions. Raises SceneError for
    features that are all equal.
    """
    if dim < 1:
        raise SceneError.expected("at least 1", dim, name="dim")
    expect_varied(features)
    values = features.features.double()
    values = values - values.mean(0)
    variances, directions = torch.linalg.eigh(values.T @ values / len(values))
    variances, directions = variances.flip(0), directions.flip(1)
    # What is below the rounding of float32 features varies in no direction.
    kept = min(dim, int((variances > 1e-10 * variances[0]).sum()))
    variances, directions = variances[:kept], directions[:, :kept]
    largest = directions.gather(0, directions.abs().argmax(0, keepdim=True))
    reduced = values @ (directions * largest.sign()) / variances.sqrt()
    return FeatureField(features.points, reduced.float(), f"{features.encoder}, {kept} components")


def expect_varied(features: FeatureField) -> None:
    """Raise SceneError for features that are all equal."""
    if not bool((features.features != features.features[:1]).any()):
        got, advice = f"{len(features.features)} equal ones", "use another encoder, or only positions"
        wanted = "features that differ over the object"
        raise SceneError.expected(wanted, len(features.features), got=got, name=features.encoder, advice=advice)


def resize(features: FeatureField, size: float) -> FeatureField:
    """Return the features times what makes their root mean square length over the points `size`.

    Raises SceneError for features that are all zero.
    """
    length = float(features.features.double().square().sum(1).mean().sqrt())
    if not length > 0:
        raise SceneError.expected("features other than zero", 0.0, name=features.encoder, advice="use another encoder")
    return FeatureField(features.points, features.features * (size / length), features.encoder)


def with_positions(features: FeatureField) -> FeatureField:
    """Return the features with the points' positions before them, as `FeatureField.from_points` has them.

    Color alone does not distinguish a bowl's left from its right; a gain field may need to. Positions have a norm of 1
    at most and a root mean square of about .5; `resize` gives features a comparable size.
    """
    positions = FeatureField.from_points(features.points).features
    joined = torch.cat([positions, features.features.float()], dim=1)
    return FeatureField(features.points, joined, f"{GEOMETRY} and {features.encoder}")


def _half_diagonal(points: Float[Tensor, "points 3"]) -> float:
    return math.dist(points.amax(0).tolist(), points.amin(0).tolist()) / 2


def _expect_extent(points: Float[Tensor, "points 3"]) -> None:
    if len(points) == 0 or not bool(torch.isfinite(points).all()) or _half_diagonal(points) == 0.0:
        got = f"{len(points)} at one position or not finite"
        raise FitError.expected("points that span an object", len(points), got=got, name="points")


_KIND = FileKind(FEATURES_KEY, "a file of features", "compute the features again", SceneError, formats=(1,))


def save_features(features: FeatureField, path: str | Path, *, report: dict[str, Any] | None = None) -> None:
    """Write features to one file, which `load_features` reads back to the last bit.

    `report` is saved with them as JSON. An existing file is replaced only when the new one is complete. Raises
    SceneError where the file cannot be written, or could not be read back.
    """
    path = Path(path)
    tensors = {"points": features.points.float(), "features": features.features.float()}
    record = {
        "encoder": features.encoder,
        "sizes": {"points": features.features.shape[0], "dim": features.features.shape[1]},
        "report": report or {},
    }
    _restored(record, tensors, path)
    write_tensors(path, tensors, _KIND.to_text(record, path, name="report"), _KIND)


def load_features(path: str | Path) -> FeatureField:
    """Read features that `save_features` wrote.

    Raises SceneError for a file that is missing, truncated, of another kind or of another format, and where its tensors
    are not those of its header.
    """
    return _read(Path(path))[1]


def read_report(path: str | Path) -> dict[str, Any]:
    """Return the report that features were saved with. Raises SceneError as `load_features`."""
    return _read(Path(path))[0]["report"]


def _read(path: Path) -> tuple[dict[str, Any], FeatureField]:
    """Return the header's record and the features, both checked."""
    text, tensors = read_tensors(path, _KIND)
    record = _KIND.parse(text, path, _check_record)
    return record, _restored(record, tensors, path)


def _check_record(record: dict[str, Any]) -> None:
    counts = [record["sizes"][name] for name in ("points", "dim")]
    kinds = isinstance(record["encoder"], str) and isinstance(record["report"], dict)
    if not kinds or any(type(count) is not int or count < 1 for count in counts):
        raise ValueError(f"sizes {record['sizes']}, encoder {record['encoder']!r}")


def _restored(record: dict[str, Any], tensors: dict[str, Tensor], path: Path) -> FeatureField:
    (count, dim), read = (record["sizes"][name] for name in ("points", "dim")), TensorReader(tensors, path, _KIND)
    points, features = (
        read(name, count, size, dtype=torch.float32) for name, size in (("points", 3), ("features", dim))
    )
    read.expect_end()
    return FeatureField(points, features, record["encoder"])
