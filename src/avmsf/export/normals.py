"""Outward normals of a surface that is given by points alone."""

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.gaussians.neighborhoods import read_neighborhoods

_NEIGHBORS = 12
"""Neighbors in the graph along which the orientation is propagated."""
_VIEWS = 128
"""Directions in which the outermost points of a component are determined."""


def outward_normals(points: Float[Tensor, "points 3"]) -> Float32[Tensor, "points 3"]:
    """Return outward unit normals of the surface on which points lie.

    Fitted planes have no orientation. It is propagated along the minimum spanning tree of the neighbor graph, weighted
    by the change of the normal (Hoppe et al. 1992), and each connected component is oriented so that the normals of its
    outermost points point outwards. The normals of very few points point away from their centroid.
    """
    places = points.detach().double().cpu().numpy()
    if len(places) <= _NEIGHBORS:
        return torch.from_numpy(_away(places)).float()
    normals = read_neighborhoods(places, count=_NEIGHBORS).normals
    _, rows = cKDTree(places).query(places, k=_NEIGHBORS + 1)
    tails, heads = np.repeat(np.arange(len(places)), _NEIGHBORS), rows[:, 1:].reshape(-1)
    # Not zero for equal normals: a sparse graph has no edges of weight zero.
    bend = 1.0 - np.abs(np.einsum("nd,nd->n", normals[tails], normals[heads])) + 1e-9
    edges = (np.minimum(tails, heads), np.maximum(tails, heads))
    _, first = np.unique(np.stack(edges, axis=1), axis=0, return_index=True)
    tree = minimum_spanning_tree(
        coo_matrix((bend[first], (edges[0][first], edges[1][first])), shape=(len(places),) * 2).tocsr()
    )
    count, part = connected_components(tree, directed=False)
    views = _sphere(_VIEWS)
    for number in range(count):
        members = np.flatnonzero(part == number)
        normals[members] = _handed_on(tree, normals, int(members[0]))[members]
        outermost = members[np.argmax(places[members] @ views.T, axis=0)]
        if np.einsum("vd,vd->", normals[outermost], views) < 0:
            normals[members] *= -1.0
    return torch.from_numpy(normals).float()


def _handed_on(tree: object, normals: Float[np.ndarray, "points 3"], start: int) -> Float[np.ndarray, "points 3"]:
    turned = normals.copy()
    order, parents = breadth_first_order(tree, start, directed=False)
    for row in order[1:]:
        if turned[row] @ turned[parents[row]] < 0:
            turned[row] *= -1.0
    return turned


def _away(places: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    offsets = places - places.mean(axis=0)
    length = np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.where(length > 0, offsets / np.maximum(length, np.finfo(float).tiny), [0.0, 0.0, 1.0])


def _sphere(count: int) -> Float[np.ndarray, "views 3"]:
    """Return evenly distributed directions: a Fibonacci spiral on the sphere."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
