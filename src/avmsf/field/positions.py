"""Whether positions lie on an object, by the points that its field knows and the body of its gains."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.capture.placement import TOLERANCE
from avmsf.errors import PositionError
from avmsf.field.gains.model import GainModel


def expect_near(
    positions: Float[Tensor, "contacts 3"],
    points: Float[Tensor, "points 3"],
    label: Callable[[int], str] = "positions, row {}".format,
) -> None:
    """Raise PositionError for a position farther outside the box of an object's points than the object is large.

    Such a position counts another unit, or is in another frame. `label` says where a row's position was given.
    """
    places, known = positions.double(), points.detach().cpu().double()
    low, high = known.amin(0), known.amax(0)
    size = float((high - low).norm())
    outside = torch.clamp(torch.maximum(low - places, places - high), min=0).norm(dim=1)
    far = torch.nonzero(~(outside <= size)).flatten()
    if len(far):
        found = places[row := int(far[0])].tolist()
        where = ", ".join(f"{value:.4g}" for value in found)
        raise PositionError(
            f"{label(row)}: expected positions on the object, in meters, got ({where}), "
            f"{float(outside[row]):.3g} m outside an object {size:.3g} m across; check the unit and the frame",
            name="positions", row=row, value=found,
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


def off_surface_gains(gains: GainModel) -> str:
    """Return a message on which gains a position off the object has.

    Mode shapes of a body are those of its nearest surface point; kernels of the position take the position itself.
    """
    if gains.body is None:
        return "the gains there are extrapolated"
    return "its gains are about those of the nearest surface point"


def points_on_object(gains: GainModel) -> Float32[Tensor, "points 3"]:
    """Return the points of gains that are not `off_surface`: a reconstruction may close a deep cavity of the body.

    All of them where that would be none.
    """
    if not len(gains.points):
        return gains.points
    off = [row for row, _ in off_surface(gains.points, gains)]
    on = torch.ones(len(gains.points), dtype=torch.bool)
    on[off] = False
    return gains.points[on] if bool(on.any()) else gains.points
