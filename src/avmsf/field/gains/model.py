"""What every gain model is: gains at contacts, what is known of their errors, and nothing about time.

And whether positions lie on its object, by the points that it knows and its body.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Complex, Complex128, Float, Float32, Float64, Inexact
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.tensor_files import TensorReader
from avmsf.capture.placement import TOLERANCE
from avmsf.errors import PositionError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.mesh.surface import Surface

Points = Float[Tensor, "contacts 3"]
"""Where impacts hit, object frame, meters."""
Directions = Float[Tensor, "contacts 3"] | None
"""Unit vectors along which the hammer moves."""


@dataclass(frozen=True, eq=False)
class Gains:
    """How strongly impacts at some contacts excite each mode."""

    mean: Inexact[Tensor, "contacts modes"]
    """Signed amplitudes, in the unit of the training sounds, of what starts with each mode's phase; the imaginary part
    is a quarter of a period ahead. Real where there is none. Times exp(i phase) they are like `Extraction.gains`."""
    _: KW_ONLY
    damping: Float[Tensor, "contacts modes"] | None = None
    """Factors on the modes' dampings; None where these are the same everywhere."""
    std: Float[Tensor, "contacts modes 2"] | None = None
    """Posterior standard deviations of real and imaginary part, without measurement noise; None where not known."""

    @classmethod
    def of(cls, series: Float64[Tensor, "contacts series"]) -> "Gains":
        """Return gains of series as `series_of` has them, in float32."""
        return cls(complex_of(series.float()))

    @property
    def parts(self) -> Float64[Tensor, "contacts modes 2"]:
        """Real and imaginary parts."""
        return torch.view_as_real(self.mean.to(torch.complex128))

    @property
    def power(self) -> Float64[Tensor, "contacts modes"]:
        """Squares of the amplitudes, whatever their phase."""
        return self.parts.square().sum(2)

    def dampings(self, shared: Float64[Tensor, " modes"]) -> Float64[Tensor, "*contacts modes"]:
        """Return the modes' dampings, 1/s: those that all contacts share, times the factors if there are any."""
        return shared if self.damping is None else shared * self.damping

    def energy(self, damping: Float64[Tensor, " modes"]) -> Float64[Tensor, " modes"]:
        """Return each mode's energy over time, gain^2 / (4 d), as the mean over the contacts; damping d in 1/s."""
        return (self.power / (4.0 * self.dampings(damping))).mean(0)


def series_of(values: Complex128[Tensor, "contacts modes"]) -> Float64[Tensor, "contacts series"]:
    """Return the series of complex gains: the real parts of all modes, then the imaginary parts."""
    return torch.cat([values.real, values.imag], dim=1)


def complex_of(series: Float[Tensor, "contacts series"]) -> Complex[Tensor, "contacts modes"]:
    """Return the complex gains whose `series_of` these are."""
    return torch.complex(*series.chunk(2, dim=1))


class GainModel(ABC):
    """Gains at every contact with one object. One contract test holds for all subclasses.

    Models that know of directions take an impact straight into the surface where none are given; others ignore them.
    """

    kind: ClassVar[str]
    """What a file calls it."""
    points: Float[Tensor, "points 3"]
    """Points of the object's surface, object frame, meters: where pictures and searches look."""
    length: float = 1.0
    """Lengths on this object over those on the object that the gains were fitted to."""
    scale: Float64[Tensor, " modes"] | float = 1.0
    """Gains over the fitted ones."""

    @property
    def fitted(self) -> "GainModel":
        """The gains as they were fitted, beneath all edits."""
        return self

    @property
    def body(self) -> ElasticModes | None:
        """The body whose mode shapes the gains know, of the size before all edits; None without one."""
        return None

    @property
    def contacts(self) -> Float64[Tensor, "contacts 3"]:
        """Contacts that the gains were fitted to, on the object as it is; none where these are not known."""
        return self.points[:0].double()

    @property
    def surface(self) -> Surface | None:
        """The surface of the body that gains are computed on, object frame, meters; None without a body."""
        body = self.body
        return None if body is None else Surface(self.length * body.nodes.float(), body.triangles[:, :3])

    def normals(self, points: Float[Tensor, "points 3"]) -> Float64[Tensor, "points 3"] | None:
        """Return the outward unit normals of the body's surface nearest to points, or None without a body."""
        return None if self.body is None else self.body.normals(points.double() / self.length)

    @abstractmethod
    def predict(self, points: Points, directions: Directions = None) -> Gains:
        """Return the mean gains of impacts at points."""

    def point_estimate(self, points: Points, directions: Directions = None) -> Gains:
        """Return the gains that sounds are rendered with: the mean, except for a posterior whose mean cancels.

        Sounds are compared by magnitudes. Where hypotheses agree that a mode is loud but not on its sign, the mean is
        near zero, and the magnitude that they expect serves better.
        """
        return self.predict(points, directions)

    def posterior(self, points: Points, directions: Directions = None) -> Gains:
        """Return the mean gains with their standard deviations, which models without a posterior do not have."""
        return self.predict(points, directions)

    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Return what a file holds besides the tensors, as plain values, sizes included, that of `modes` among them."""

    @abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Return what a file holds, by name."""

    @classmethod
    @abstractmethod
    def restore(cls, record: Mapping[str, Any], read: TensorReader) -> "GainModel":
        """Return the model of a record and its tensors.

        Raises RecordError, ValueError, TypeError or KeyError for a record of no such model, and as the reader does.
        """


def expect_near(
    positions: Float[Tensor, "contacts 3"],
    points: Float[Tensor, "points 3"],
    label: Callable[[int], str] | None = None,
    name: str = "positions",
) -> None:
    """Raise PositionError for a position farther outside the box of an object's points than the object is large.

    Such a position counts another unit, or is in another frame. `label` says where a row's position was given, by
    default by their `name`.
    """
    places, known = positions.double(), points.detach().cpu().double()
    low, high = known.amin(0), known.amax(0)
    size = float((high - low).norm())
    outside = torch.clamp(torch.maximum(low - places, places - high), min=0).norm(dim=1)
    far = torch.nonzero(~(outside <= size)).flatten()
    if len(far):
        found = places[row := int(far[0])].tolist()
        where = ", ".join(f"{value:.4g}" for value in found)
        given = f"{name}, row {row}" if label is None else label(row)
        raise PositionError(
            f"{given}: expected positions on the object, in meters, got ({where}), "
            f"{float(outside[row]):.3g} m outside an object {size:.3g} m across; check the unit and the frame",
            name=name, row=row, value=found,
        )  # fmt: skip


def off_surface(positions: Float[Tensor, "contacts 3"], gains: GainModel) -> list[tuple[int, float]]:
    """Return the rows of positions that lie off the object of gains, and their distances from it, meters.

    The object is the surface of the gains' body, or without a body their points. Off it is what is farther than
    `TOLERANCE` of the diagonal of the points' box, and without a body farther than twice the greatest distance from a
    point to its neighbor.
    """
    known, places, body = gains.points.detach().cpu().double(), positions.detach().cpu().double(), gains.body
    limit = TOLERANCE * float((known.amax(0) - known.amin(0)).norm())
    if body is not None:
        distances = gains.length * body.distances(places / gains.length)
    else:
        tree = cKDTree(known.numpy())
        distances = torch.from_numpy(tree.query(places.numpy())[0])
        if bool((distances > limit).any()):
            limit = max(limit, 2.0 * float(tree.query(known.numpy(), k=2)[0][:, -1].max()))
    return [(row, float(distances[row])) for row in torch.nonzero(distances > limit).flatten().tolist()]


def points_on_object(gains: GainModel) -> Float32[Tensor, "points 3"]:
    """Return the points of gains that are not `off_surface`: a reconstruction may close a deep cavity of the body.

    All of them where that would be none.
    """
    off = [row for row, _ in off_surface(gains.points, gains)]
    on = torch.ones(len(gains.points), dtype=torch.bool)
    on[off] = False
    return gains.points[on] if bool(on.any()) else gains.points
