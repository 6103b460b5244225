"""Second-order tetrahedra: their nodes, and the stiffness and mass matrices of linear elasticity on them.

A cell has ten nodes, its corners and the middles of its edges, and straight edges, so that the gradients of its
barycentric coordinates are constant in it. Its shape functions are l_i (2 l_i - 1) at corner i and 4 l_i l_j between
the corners i and j. The products of their gradients are of second degree, which four points integrate exactly; the
mass matrix is the same for all cells but for their volume.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.fem.material import Material
from avmsf.fem.solid import Solid

_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
"""Corners at the ends of the edges on whose middles a cell's nodes 4 to 9 lie."""
_SIDES = np.array([[1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6], [0, 1, 3, 4, 8, 7], [0, 2, 1, 6, 5, 4]])
"""A cell's nodes on its sides: corners in the order of `Solid.boundary`, then the middles of the edges between them."""
_INNER, _OUTER = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0, (5.0 - np.sqrt(5.0)) / 20.0
_QUADRATURE = np.full((4, 4), _OUTER) + np.eye(4) * (_INNER - _OUTER)
"""Barycentric coordinates of four points of equal weight, exact to the second degree."""


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """A solid with a node in the middle of each edge."""

    solid: Solid
    nodes: Float64[np.ndarray, "nodes 3"]
    """The solid's points, then the middles of the edges, meters."""
    cells: Int[np.ndarray, "cells 10"]
    """Rows of `nodes`: a cell's corners, then the middles of its edges 01, 12, 02, 03, 13 and 23."""

    @classmethod
    def of(cls, solid: Solid) -> "SecondOrder":
        """Return the nodes on a solid."""
        points, corners = solid.points.numpy(), solid.cells.numpy()
        ends = np.sort(corners[:, _EDGES], axis=-1).reshape(-1, 2)
        # One number an edge sorts many times faster than rows of two.
        keys, which = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
        middles = 0.5 * (points[keys // len(points)] + points[keys % len(points)])
        edges = which.reshape(-1, len(_EDGES)) + len(points)
        return cls(solid, np.concatenate([points, middles]), np.concatenate([corners, edges], axis=1))

    @cached_property
    def boundary(self) -> Int[np.ndarray, "triangles 6"]:
        """Rows of `nodes` on the outer triangles: corners, then the middles of the edges 01, 12 and 20."""
        return self.cells[:, _SIDES].reshape(-1, 6)[self.solid.outer]

    @cached_property
    def surface(self) -> tuple[Int[np.ndarray, " outer"], Int[np.ndarray, "triangles 6"]]:
        """Rows of the nodes on the outer triangles, ascending, and those triangles as places among these rows."""
        outer, triangles = np.unique(self.boundary, return_inverse=True)
        return outer, triangles.reshape(-1, 6)

    def assemble(
        self, factors: Float64[np.ndarray, "cells 10 10 size size"] | Float64[np.ndarray, "cells 10 10"]
    ) -> scipy.sparse.bsr_array | scipy.sparse.csr_array:
        """Return the matrix that sums the cells' own, over nodes or over the components of a vector at each node."""
        order, starts, rows, columns = self._pattern
        entries = factors.reshape(len(self.cells) * 100, -1)
        summing = scipy.sparse.csr_array((np.ones(len(order)), order, starts), shape=(len(rows), len(entries)))
        summed = summing @ entries
        pointer = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(self.nodes)))])
        if factors.ndim == 3:
            return scipy.sparse.csr_array((summed[:, 0], columns, pointer), shape=(len(self.nodes),) * 2)
        size = factors.shape[-1]
        blocks = summed.reshape(-1, size, size)
        return scipy.sparse.bsr_array((blocks, columns, pointer), shape=(size * len(self.nodes),) * 2)

    @cached_property
    def _pattern(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The cells' pairs of nodes in the order of the matrix, where each entry's begin, its row and its column."""
        pairs = (self.cells[:, :, None] * len(self.nodes) + self.cells[:, None, :]).ravel()
        order = np.argsort(pairs, kind="stable")
        ordered = pairs[order]
        first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        entries = ordered[first]
        return order, np.append(first, len(order)), entries // len(self.nodes), entries % len(self.nodes)


def stiffness(
    mesh: SecondOrder, material: Material, factor: Float[Tensor, " cells"] | None = None
) -> scipy.sparse.bsr_array:
    """Return the stiffness matrix over the components of the nodes' displacements, newtons per meter.

    `factor` multiplies Young's modulus, a number a cell. Row 3 n + i is the force along axis i on node n.
    """
    young = material.young * (np.ones(len(mesh.cells)) if factor is None else factor.double().numpy())
    shear = young / (2.0 * (1.0 + material.poisson))
    squeeze = shear * 2.0 * material.poisson / (1.0 - 2.0 * material.poisson)
    slopes = shape_gradients(mesh)
    weight = mesh.solid.volumes.numpy() / len(_QUADRATURE)
    flat = slopes.reshape(len(slopes), len(_QUADRATURE), 30)
    # products[cell, a, i, b, j]: the integral of the slope of a's function along i times that of b's along j.
    products = np.matmul(flat.transpose(0, 2, 1), flat * weight[:, None, None]).reshape(-1, 10, 3, 10, 3)
    products = products.transpose(0, 1, 3, 2, 4)
    blocks = squeeze[:, None, None, None, None] * products
    blocks += shear[:, None, None, None, None] * products.swapaxes(3, 4)
    along = shear[:, None, None] * np.trace(products, axis1=3, axis2=4)
    for axis in range(3):
        blocks[:, :, :, axis, axis] += along
    return mesh.assemble(blocks)


def mass(mesh: SecondOrder, density: Float64[Tensor, " cells"]) -> scipy.sparse.csr_array:
    """Return the consistent mass matrix over the nodes, kilograms; all three components have the same.

    `density` is in kilograms per cubic meter.
    """
    weight = (mesh.solid.volumes * density).numpy()
    return mesh.assemble(weight[:, None, None] * REFERENCE_MASS)


def shape_gradients(mesh: SecondOrder) -> Float64[np.ndarray, "cells points 10 3"]:
    """Return the gradients of the shape functions at the quadrature's points, 1/m."""
    corners = mesh.nodes[mesh.cells[:, :4]]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2).transpose(0, 2, 1)
    return np.matmul(_reference_slopes(_QUADRATURE)[None], gradients[:, None])


def _reference_slopes(places: Float64[np.ndarray, "points 4"]) -> Float64[np.ndarray, "points 10 4"]:
    """Return the derivatives of the shape functions by the four barycentric coordinates."""
    slopes = np.zeros((len(places), 10, 4))
    slopes[:, range(4), range(4)] = 4.0 * places - 1.0
    for edge, (one, other) in enumerate(_EDGES):
        slopes[:, 4 + edge, one] = 4.0 * places[:, other]
        slopes[:, 4 + edge, other] = 4.0 * places[:, one]
    return slopes


_ENDS = np.eye(4)[_EDGES].sum(axis=1)
REFERENCE_MASS = (
    np.block([[1.0 + 5.0 * np.eye(4), 2.0 * _ENDS.T - 6.0], [2.0 * _ENDS - 6.0, 8.0 * 2.0 ** (_ENDS @ _ENDS.T)]])
    / 420.0
)
"""Integrals of the products of shape functions over a cell of volume 1, [10, 10]: corners, then middles of edges."""
