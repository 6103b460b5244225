"""Points on an object: which to strike, which are near, which belong together, and points where none are known.

All distances are Euclidean, in meters, taken in float64 whatever the points come in. Ties go to the point that comes
first, and contacts on a regular grid are full of ties: read them in float64, for what was a tie as it was written
in decimals is broken by the rounding of float32, and then another split or another neighbor comes out.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import EvaluationError, FitError


def farthest_points(points: Float[Tensor, "points 3"], count: int, *, start: int = 0) -> Int[Tensor, " chosen"]:
    """Return `count` rows, the first of them `start`, each the farthest from all that were chosen before it.

    Never the same row twice, even where points coincide. Raises EvaluationError for a count or start that the points
    do not have.
    """
    _expect_rows(points, count, start)
    x, y, z = points.double().cpu().T.contiguous().numpy()
    apart, chosen = np.full(len(x), np.inf), np.empty(count, dtype=np.int64)
    last = start
    for turn in range(count):
        chosen[turn] = last
        # Chosen rows are barred rather than at distance zero, where they would tie with points that coincide.
        apart[last] = -np.inf
        # The root, for it makes ties of what rounding of the squares would tell apart.
        np.minimum(apart, np.sqrt((x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2), out=apart)
        last = int(apart.argmax())
    return torch.from_numpy(chosen)


def nearest_points(
    points: Float[Tensor, "points 3"], queries: Float[Tensor, "queries 3"], *, count: int = 1
) -> Int[Tensor, "queries count"]:
    """Return for each query the rows of the `count` points nearest to it, nearest first.

    Raises EvaluationError for a count that the points do not have.
    """
    _expect_rows(points, count, 0)
    tree = cKDTree(points.detach().double().cpu().numpy())
    places = queries.detach().double().cpu().numpy()
    # One neighbor more than asked for shows whether the last place is a tie, which the tree breaks as it likes.
    sought = min(count + 1, len(points))
    while True:
        distances, rows = tree.query(places, k=np.arange(1, sought + 1))
        undecided = sought < len(points) and bool((distances[:, -1] == distances[:, count - 1]).any())
        if not undecided:
            break
        sought = min(2 * sought, len(points))
    order = np.lexsort((rows, distances), axis=1)[:, :count]
    return torch.from_numpy(np.take_along_axis(rows, order, axis=1)).long().to(queries.device)


def cluster(
    points: Float[Tensor, "points 3"], count: int, *, iterations: int = 100
) -> tuple[Float[Tensor, "clusters 3"], Int[Tensor, " points"]]:
    """Return the means of `count` groups of the points, none of them empty, and which group each point belongs to.

    By k-means: Lloyd's iteration from farthest points, until no label changes. The result is deterministic. A group
    that loses its last point restarts at the point that is farthest from its center. Raises FitError where the points
    have fewer than `count` different positions.
    """
    places = points.detach().double().cpu()
    distinct = len(torch.unique(places, dim=0)) if len(places) else 0
    if not 1 <= count <= distinct:
        raise FitError.expected(f"1 to {distinct} clusters, as many as different positions", count, name="count")
    centers = places[farthest_points(places, count)]
    labels = nearest_points(centers, places)[:, 0]
    for _ in range(iterations):
        centers = _centers(places, labels, centers)
        moved = nearest_points(centers, places)[:, 0]
        if torch.equal(moved, labels) and len(torch.unique(labels)) == count:
            break
        labels = moved
    return centers.to(points), labels.to(points.device)


def lattice(contacts: Float[Tensor, "contacts 3"], count: int) -> Float[Tensor, "points 3"]:
    """Return at most `count` points that fill the contacts' bounding box evenly, its corners among them.

    What stands for an object of which only contacts are known. The spacing is the same along all axes as far as whole
    numbers allow; an axis along which the contacts do not differ holds one layer. Raises EvaluationError for fewer
    points than the box has corners.
    """
    lowest, highest = contacts.double().amin(0), contacts.double().amax(0)
    extent = (highest - lowest).tolist()
    longest = max(extent)
    # What is flatter than a thousandth of the longest side is a plane or a line measured with errors.
    wide = [side > 1e-3 * longest for side in extent]
    corners = 2 ** sum(wide)
    if count < corners:
        raise EvaluationError.expected(f"at least {corners}, the corners of the box", count, name="count")
    numbers = [1, 1, 1]
    for spacing in (longest / steps for steps in range(1, count + 1)):
        finer = [1 + max(1, round(side / spacing)) if on else 1 for side, on in zip(extent, wide, strict=True)]
        if math.prod(finer) > count:
            break
        numbers = finer
    axes = [
        torch.linspace(float(low), float(high), number, dtype=torch.float64)
        if number > 1
        else torch.tensor([0.5 * float(low + high)], dtype=torch.float64)
        for low, high, number in zip(lowest, highest, numbers, strict=True)
    ]
    return torch.cartesian_prod(*axes).reshape(-1, 3).to(contacts)


def _centers(
    places: Float[Tensor, "points 3"], labels: Int[Tensor, " points"], centers: Float[Tensor, "clusters 3"]
) -> Float[Tensor, "clusters 3"]:
    """Return the mean of each cluster's points; of the clusters that have none, the first gets the farthest point.

    The others stay where they are until their turn comes: two that began on coinciding points would be one again.
    """
    sizes = torch.bincount(labels, minlength=len(centers))
    means = torch.zeros_like(centers).index_add(0, labels, places) / sizes.clamp(min=1)[:, None]
    means = torch.where(sizes[:, None] > 0, means, centers)
    empty = torch.nonzero(sizes == 0).flatten()
    if len(empty):
        means[empty[0]] = places[torch.argmax((places - means[labels]).norm(dim=1))]
    return means


def _expect_rows(points: Float[Tensor, "points 3"], count: int, start: int) -> None:
    if not 1 <= count <= len(points):
        raise EvaluationError.expected(f"1 to {len(points)} points", count, name="count")
    if not 0 <= start < len(points):
        raise EvaluationError.expected(f"a point from 0 to {len(points) - 1}", start, name="start")


def connected_parts(pairs: Int[np.ndarray, "pairs 2"], count: int) -> Int[np.ndarray, " items"]:
    """Return the number of the connected part of each of `count` items, given pairs that are connected."""
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    parts: Int[np.ndarray, " items"] = connected_components(links, directed=False)[1]
    return parts


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1 along the last axis; what has no length stays."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
