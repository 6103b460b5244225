"""Which way is out of an object of which only points are known."""

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.scene.neighborhoods import read_neighborhoods

_NEIGHBORS = 12
"""Points that a side is handed on to."""
_VIEWS = 128
"""Directions from which a part's outermost points are looked at."""


def outward_normals(points: Float[Tensor, "points 3"]) -> Float32[Tensor, "points 3"]:
    """Return unit normals of the surface that points lie on, out of the object.

    Planes through neighbors have no side. One side is handed on along the tree of neighbors that bends least (after
    Hoppe et al. 1992), and each part of the surface is turned such that its outermost points, seen from all around,
    face outwards. A few points have no surface: theirs point away from their middle.
    """
    places = points.detach().double().cpu().numpy()
    if len(places) <= _NEIGHBORS:
        return torch.from_numpy(_away(places)).float()
    normals = read_neighborhoods(places, count=_NEIGHBORS).normals
    _, rows = cKDTree(places).query(places, k=_NEIGHBORS + 1)
    tails, heads = np.repeat(np.arange(len(places)), _NEIGHBORS), rows[:, 1:].reshape(-1)
    # Where the normals agree an edge costs next to nothing, but more than the nothing that a sparse graph leaves out.
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
    """Return directions evenly over the sphere, along a spiral of golden angles."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
