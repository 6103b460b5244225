"""The modes of one body as functions of its isotropic material.

Stiffness is linear in Lamé's constants, K = mu A + lambda B, and mass M is linear in the density. With Young's modulus
E, density rho and Poisson's ratio nu,

    mu = E / (2 (1 + nu)),   lambda = E nu / ((1 + nu) (1 - 2 nu)),

so the squared angular frequencies are (E / rho) m_i(nu), exactly, and shapes depend on nu alone. The dependence on nu
is smooth: the problem is projected on the mode shapes at a few values of nu (a reduced basis: Noor and Peters, AIAA
Journal 18, 1980), where it is exact; between them the error of m_i is of second order in that of the shapes. Modes
need not be tracked from one value to the next.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.fem.eigen import lowest_vibrations, rigid_motions, times
from avmsf.fem.elastic_modes import RELATIVE_SHIFT, ElasticModes
from avmsf.fem.elements import SecondOrder, mass, stiffness
from avmsf.fem.material import Material
from avmsf.fem.solid import Solid

SAMPLED_POISSON = (0.05, 0.33, 0.485)
"""Values of Poisson's ratio whose mode shapes span the reduced basis."""
_SPARE = 8
"""Modes of each value beyond those wanted: their order changes with Poisson's ratio."""
_DEPENDENT = 1e-9
"""Squared norm of a part of the basis, over the largest, below which it is rounding."""
_UNIT_SHEAR = Material("unit shear modulus", 1.0, 2.0, 0.0, 0.0, 0.0)
_OTHER = Material("Poisson's ratio of .25", 1.0, 2.5, 0.25, 0.0, 0.0)
"""Both of Lamé's constants are 1."""


@dataclass(frozen=True, eq=False)
class IsotropicModes:
    """Lowest elastic modes of a free body, for any isotropic material."""

    count: int
    """Modes."""
    shear: Float64[Tensor, "basis basis"]
    """A on the reduced basis, whose mass matrix for a density of 1 is the identity, 1/m2."""
    squeeze: Float64[Tensor, "basis basis"]
    """B likewise, 1/m2."""
    nodes: Float64[Tensor, "nodes 3"]
    """Surface nodes, meters, as in `ElasticModes`."""
    triangles: Int[Tensor, "triangles 6"]
    shapes: Float64[Tensor, "nodes basis 3"]
    """The reduced basis at the nodes, m^-1.5."""
    volume: float
    """Cubic meters."""

    def squares(self, poisson: Float[Tensor, ""]) -> Float64[Tensor, " modes"]:
        """Return the squared angular frequencies for E / rho = 1 m2/s2, ascending; differentiable in `poisson`."""
        return torch.linalg.eigvalsh(self._stiffness(poisson))[: self.count]

    def modes(self, material: Material) -> ElasticModes:
        """Return the modes of the body made of a material."""
        squares, mixed = torch.linalg.eigh(self._stiffness(torch.tensor(material.poisson, dtype=torch.float64)))
        shapes = torch.einsum("nbd,bm->nmd", self.shapes, mixed[:, : self.count]) / math.sqrt(material.density)
        frequency = (material.young / material.density * squares[: self.count]).sqrt() / (2.0 * math.pi)
        kilograms = material.density * self.volume
        return ElasticModes(frequency, self.nodes, self.triangles, shapes.contiguous(), material, kilograms)

    def _stiffness(self, poisson: Float[Tensor, ""]) -> Float64[Tensor, "basis basis"]:
        nu = poisson.double()
        return self.shear / (2.0 * (1.0 + nu)) + self.squeeze * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def isotropic_modes(solid: Solid, *, count: int) -> IsotropicModes:
    """Return the lowest `count` modes of a free body for any isotropic material, by second-order finite elements.

    Raises SimulationError for a body of several parts, and one whose modes cannot be computed.
    """
    solid.expect_connected()
    mesh = SecondOrder.of(solid)
    weights = mass(mesh, torch.ones(len(solid.cells), dtype=torch.float64))
    shear = stiffness(mesh, _UNIT_SHEAR)
    squeeze = stiffness(mesh, _OTHER) - shear
    rigid = rigid_motions(mesh.nodes, weights)
    found = []
    for poisson in SAMPLED_POISSON:
        forces = shear / (2.0 * (1.0 + poisson)) + squeeze * (poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)))
        shift = RELATIVE_SHIFT / solid.size**2
        _, shapes = lowest_vibrations(forces, weights, rigid, count=count + _SPARE, shift=shift, supported=False)
        found.append(shapes)
    spread = np.concatenate(found, axis=1)
    squares, turned = np.linalg.eigh(spread.T @ times(weights, spread))
    kept = squares > _DEPENDENT * squares[-1]
    basis = spread @ (turned[:, kept] / np.sqrt(squares[kept]))
    outer, triangles = mesh.surface
    shapes = basis.reshape(len(mesh.nodes), 3, -1)[outer].transpose(0, 2, 1)
    return IsotropicModes(
        count=count,
        shear=_symmetric(basis.T @ (shear @ basis)),
        squeeze=_symmetric(basis.T @ (squeeze @ basis)),
        nodes=torch.from_numpy(mesh.nodes[outer]),
        triangles=torch.from_numpy(triangles),
        shapes=torch.from_numpy(np.ascontiguousarray(shapes)),
        volume=solid.volume,
    )


def _symmetric(matrix: Float64[np.ndarray, "basis basis"]) -> Float64[Tensor, "basis basis"]:
    return torch.from_numpy(0.5 * (matrix + matrix.T))
