"""The vibrations of an elastic body: natural frequencies, and how far each place moves in each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.eigen import lowest_vibrations, rigid_motions
from avmsf.fem.elements import SecondOrder, mass, stiffness
from avmsf.fem.material import Material
from avmsf.fem.perturbation import Perturbations, perturbations
from avmsf.fem.solid import Solid
from avmsf.fem.supports import Patch, Support, SupportBasis, patches_of
from avmsf.mesh.closest_point import Closest, ClosestPoints
from avmsf.mesh.surface import Surface, surface_points

RELATIVE_SHIFT = 1e-5
"""Shift of the eigenvalues over E / (density size^2), which is a tenth of the squared angular frequency of a bar."""


@dataclass(frozen=True, eq=False)
class ElasticModes:
    """Undamped modes of a body by ascending frequency, without the motions of a rigid body.

    A force j [newton seconds] at a place x sets mode k in motion with the velocity shape_k(x) . j.
    """

    frequency: Float64[Tensor, " modes"]
    """Undamped natural frequencies, Hz."""
    nodes: Float64[Tensor, "nodes 3"]
    """Places on the body's surface at which the shapes are known: corners and edge middles of its triangles, meters."""
    triangles: Int[Tensor, "triangles 6"]
    """Rows of `nodes`: three corners, counter-clockwise from outside, then the middles of the edges 01, 12 and 20."""
    shapes: Float64[Tensor, "nodes modes 3"]
    """Mass-normalized displacement, 1 / sqrt(kg): the integral of density times its square over the body is 1."""
    material: Material
    mass: float
    """Kilograms."""
    perturbations: Perturbations | None = None
    """How the modes change with the body's stiffness and density, where that was asked for."""

    def __len__(self) -> int:
        return self.frequency.shape[0]

    def at(self, places: Float[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts modes 3"]:
        """Return the shapes where the surface is nearest to each place, interpolated as the elements do."""
        rows, weights = self._interpolation(places)
        # A node at a time: the shapes of all six at once would be six times the result.
        total = torch.zeros(len(rows), *self.shapes.shape[1:], dtype=torch.float64)
        for node in range(6):
            total += weights[:, node, None, None] * self.shapes[rows[:, node]]
        return total

    def gains(
        self, places: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"]
    ) -> Float64[Tensor, "contacts modes"]:
        """Return the shapes' components along `directions` where the surface is nearest to each place, 1 / sqrt(kg).

        An impact of one newton-second along a unit vector gives a mode the velocity gain times shape. The response at
        one place to an impact at another is the product of the two gains, whichever of them is struck.
        """
        rows, weights = self._interpolation(places)
        total = torch.zeros(len(places), len(self), dtype=torch.float64)
        for node in range(6):
            along = torch.einsum("cmd,cd->cm", self.shapes[rows[:, node]], directions.double())
            total += weights[:, node, None] * along
        return total

    def normals(self, places: Float[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts 3"]:
        """Return the unit normals, out of the body, of the triangles nearest to each place."""
        corners = self.nodes[self.triangles[torch.from_numpy(self._nearest(places).rows), :3]]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return normals / normals.norm(dim=1, keepdim=True)

    def distances(self, places: Float[Tensor, "contacts 3"]) -> Float64[Tensor, " contacts"]:
        """Return the distance of each place from the surface, meters."""
        return torch.from_numpy(self._nearest(places).distances)

    def near(self, places: Float[Tensor, "contacts 3"]) -> "ElasticModes":
        """Return the modes on those triangles of the surface alone that are nearest to the places."""
        triangles = self.triangles[np.unique(self._nearest(places).rows)]
        nodes, rows = torch.unique(triangles, return_inverse=True)
        return replace(self, nodes=self.nodes[nodes], triangles=rows, shapes=self.shapes[nodes])

    def _nearest(self, places: Float[Tensor, "contacts 3"]) -> Closest:
        """Return the nearest triangles, and the nearest points of them."""
        unfit = torch.nonzero(~torch.isfinite(places).all(dim=1)).flatten()
        if len(unfit):
            row = int(unfit[0])
            raise SimulationError.expected("finite coordinates in meters", places[row].tolist(), row=row, name="places")
        return self._closest(places.double().numpy())

    def _interpolation(
        self, places: Float[Tensor, "contacts 3"]
    ) -> tuple[Int[Tensor, "contacts 6"], Float64[Tensor, "contacts 6"]]:
        """Return the nodes of the nearest triangle, and the second-order shape functions in the nearest point of it."""
        found = self._nearest(places)
        corner = torch.from_numpy(found.weights)
        weights = torch.cat([corner * (2.0 * corner - 1.0), 4.0 * corner * corner.roll(-1, dims=1)], dim=1)
        return self.triangles[torch.from_numpy(found.rows)], weights

    @cached_property
    def points(self) -> Float64[Tensor, "points 3"]:
        """Points all over the surface."""
        return surface_points(Surface(self.nodes, self.triangles[:, :3]))

    @cached_property
    def _closest(self) -> ClosestPoints:
        return ClosestPoints(self.nodes[self.triangles[:, :3]].numpy())


def elastic_modes(
    solid: Solid,
    material: Material,
    *,
    count: int = 64,
    stiffness_factor: Float[Tensor, " cells"] | None = None,
    density_factor: Float[Tensor, " cells"] | None = None,
    springs: Sequence[tuple[Float[Tensor, " 3"], float]] | None = None,
    support: Support | None = None,
    perturbed: bool = False,
) -> ElasticModes:
    """Return the lowest `count` elastic modes of a body by second-order finite elements.

    The factors multiply Young's modulus and the density in each cell. The body is free, or held by `springs`: places
    on its surface and their stiffness in newtons per meter, the same in all directions. A free body's six rigid
    motions are no modes of it. On soft springs they are slow modes, and every mode that has more than half of its
    kinetic energy in a rigid motion is left out. Springs so stiff that the body bends before it moves as a whole
    leave no such mode, and then none is left out. On a `support` they are modes like all others, but for turns about a
    patch that no spring opposes. With `perturbed` the
    modes come with the first-order changes of their matrices, for a body without factors.

    Raises SimulationError for a body of several parts or too few nodes, and factors and springs that are not positive.
    """
    if count < 1:
        raise SimulationError.expected("1 mode or more", count, name="count")
    if perturbed and (stiffness_factor is not None or density_factor is not None):
        raise SimulationError.expected(
            "no stiffness or density factors", True, got="some", name="perturbed", advice="leave them out"
        )
    light = _factor(solid, density_factor, "density_factor")
    mesh, forces, weights, shift = _matrices(
        solid, material, light, _factor(solid, stiffness_factor, "stiffness_factor")
    )
    if springs:
        forces = forces + _support(mesh, springs)
    if support is not None:
        forces = forces + support.springs(mesh)
    rigid = rigid_motions(mesh.nodes, weights)
    found = lowest_vibrations(
        forces, weights, rigid if support is None else np.zeros_like(rigid), count=count, shift=shift,
        supported=bool(springs) or support is not None,
    )  # fmt: skip
    total = float((solid.volumes * light).sum()) * material.density
    changes = perturbations(mesh, found.shapes.reshape(len(mesh.nodes), 3, -1), material) if perturbed else None
    return replace(_modes(mesh, found.squares, _at_surface(mesh, found.shapes), material, total), perturbations=changes)


class HeldModes:
    """The modes of a body on any support, of one computation of its free ones."""

    def __init__(
        self, solid: Solid, material: Material, *, count: int = 64, patches: Sequence[Patch] | None = None
    ) -> None:
        """Compute the free modes and the responses to forces on the patches, by default `patches_of` the body.

        Raises SimulationError as `elastic_modes`, and for a body without a small part that it could be held at.
        """
        even = torch.ones(len(solid.cells), dtype=torch.float64)
        mesh, forces, weights, shift = _matrices(solid, material, even, even)
        rigid = rigid_motions(mesh.nodes, weights)
        free = lowest_vibrations(forces, weights, rigid, count=count, shift=shift, supported=False)
        self._mesh, self._material, self._mass = mesh, material, float(solid.volumes.sum()) * material.density
        self.free = _modes(mesh, free.squares, _at_surface(mesh, free.shapes), material, self._mass)
        self.basis = SupportBasis(mesh, forces, weights, free, rigid, patches_of(mesh) if patches is None else patches)

    def on(self, support: Support) -> ElasticModes:
        """Return the lowest modes on a support of some of the basis' patches."""
        found = self.basis.held(support)
        return _modes(self._mesh, found.squares, found.shapes, self._material, self._mass)


def _matrices(
    solid: Solid, material: Material, light: Float64[Tensor, " cells"], stiff: Float64[Tensor, " cells"]
) -> tuple[SecondOrder, scipy.sparse.sparray, scipy.sparse.csr_array, float]:
    """Return the elements, their stiffness and mass, and the shift of the eigenvalues, 1/s2."""
    solid.expect_connected()
    mesh, shift = SecondOrder.of(solid), RELATIVE_SHIFT * material.young / (material.density * solid.size**2)
    return mesh, stiffness(mesh, material, stiff), mass(mesh, material.density * light), shift


def _at_surface(
    mesh: SecondOrder, shapes: Float64[np.ndarray, "dofs modes"]
) -> Float64[np.ndarray, "outer_dofs modes"]:
    """Return the shapes at the surface's nodes alone."""
    return shapes.reshape(len(mesh.nodes), 3, -1)[mesh.surface[0]].reshape(-1, shapes.shape[1])


def _modes(
    mesh: SecondOrder,
    squares: Float64[np.ndarray, " modes"],
    shapes: Float64[np.ndarray, "outer_dofs modes"],
    material: Material,
    total: float,
) -> ElasticModes:
    """Return modes of squared angular frequencies and of shapes at the surface's nodes; `total` is the mass, kg."""
    outer, triangles = mesh.surface
    return ElasticModes(
        frequency=torch.from_numpy(np.sqrt(squares) / (2.0 * math.pi)),
        nodes=torch.from_numpy(mesh.nodes[outer]),
        triangles=torch.from_numpy(triangles),
        shapes=torch.from_numpy(np.ascontiguousarray(shapes.reshape(len(outer), 3, -1).transpose(0, 2, 1))),
        material=material,
        mass=total,
    )


def _support(mesh: SecondOrder, springs: Sequence[tuple[Tensor, float]]) -> scipy.sparse.csr_array:
    """Return the stiffness that springs at the nearest points of the surface add, spread over a triangle's nodes."""
    triangles = mesh.boundary
    found = ClosestPoints(mesh.nodes[triangles[:, :3]])(np.stack([place.double().numpy() for place, _ in springs]))
    total = scipy.sparse.csr_array((3 * len(mesh.nodes),) * 2)
    for spring, (_, strength) in enumerate(springs):
        if not 0 < strength < math.inf:
            raise SimulationError.expected("a stiffness above 0 N/m", strength, row=spring, name="springs")
        corner = found.weights[spring]
        weights = np.concatenate([corner * (2.0 * corner - 1.0), 4.0 * corner * np.roll(corner, -1)])
        row = scipy.sparse.csr_array((weights, triangles[found.rows[spring]], [0, 6]), shape=(1, len(mesh.nodes)))
        total = total + scipy.sparse.kron(strength * (row.T @ row), scipy.sparse.eye_array(3), format="csr")
    return total


def _factor(solid: Solid, factor: Float[Tensor, " cells"] | None, name: str) -> Float64[Tensor, " cells"]:
    if factor is None:
        return torch.ones(len(solid.cells), dtype=torch.float64)
    if len(factor) != len(solid.cells):
        raise SimulationError.expected(f"{len(solid.cells)} numbers, one per cell", len(factor), name=name)
    unfit = torch.nonzero(~((factor > 0) & torch.isfinite(factor))).flatten()
    if len(unfit):
        row = int(unfit[0])
        raise SimulationError.expected("more than 0", float(factor[row]), row=row, name=name)
    return factor.double()
