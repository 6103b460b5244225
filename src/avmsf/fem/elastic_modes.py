"""The vibrations of an elastic body: natural frequencies, how far each place moves in each, and their files.

Held at few patches, a body vibrates in combinations of its free modes, its rigid motions and its static responses to
the patches' loads, the attachment modes of component mode synthesis (Craig and Chang, AIAA Journal 14, 1976). On this
basis every support is a dense eigenproblem of 100 to 400 unknowns.

Files of fields have the modes' tensors with shapes in float32. A file of a cache has them to the last bit, with those
of the perturbations, and in its header one JSON:

{"mass": 0.31, "material": {"name": "ceramic", "density": 2700.0, "young": 7.2e10, ...}}
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf._utils.caching import keep_if_possible
from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import TensorReader, read_tensors, write_tensors
from avmsf._utils.text import count_of, parse_json
from avmsf.errors import SimulationError
from avmsf.fem.eigen import PENDULUM, factorize, lowest_vibrations, orthonormal, rigid_motions
from avmsf.fem.elements import SecondOrder, mass, stiffness
from avmsf.fem.material import NOMINAL, Material
from avmsf.fem.perturbation import Perturbations, perturbations
from avmsf.fem.solid import Solid
from avmsf.fem.supports import Patch, Support, patches_of
from avmsf.mesh.queries import Closest, ClosestPoints
from avmsf.mesh.surface import Surface, surface_points

RELATIVE_SHIFT = 1e-5
"""Shift of the eigenvalues over E / (density size^2), which is a tenth of the squared angular frequency of a bar."""
_INDEPENDENT = 1e-5
"""Part of an attachment mode that the others and the free modes do not have, below which it is left out."""


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
        return self._interpolated(places, lambda shapes: shapes)

    def gains(
        self, places: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"]
    ) -> Float64[Tensor, "contacts modes"]:
        """Return the shapes' components along `directions` where the surface is nearest to each place, 1 / sqrt(kg).

        An impact of one newton-second along a unit vector gives a mode the velocity gain times shape. The response at
        one place to an impact at another is the product of the two gains, whichever of them is struck.
        """
        along = directions.double()
        return self._interpolated(places, lambda shapes: torch.einsum("cmd,cd->cm", shapes, along))

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
        return self._closest(places.double().numpy())

    def _interpolated(self, places: Float[Tensor, "contacts 3"], part: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the part of the shapes in the nearest points of the surface, by the second-order shape functions."""
        found = self._nearest(places)
        rows, weights = self.triangles[torch.from_numpy(found.rows)], torch.from_numpy(_quadratic(found))
        total = torch.zeros((), dtype=torch.float64)
        # A node at a time: the shapes of all six at once would be six times the result.
        for row, weight in zip(rows.T, weights.T, strict=True):
            each = part(self.shapes[row])
            total = total + weight.reshape(-1, *[1] * (each.ndim - 1)) * each
        return total

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
    springs: tuple[Float[Tensor, "springs 3"], float] | None = None,
    support: Support | None = None,
    perturbed: bool = False,
) -> ElasticModes:
    """Return the lowest `count` elastic modes of a body by second-order finite elements.

    The factors multiply Young's modulus and the density in each cell. The body is free, or held by `springs`: places
    on its surface and the stiffness of each, newtons per meter, the same in all directions. A free body's six rigid
    motions are no modes of it. On soft springs they are slow modes, and every mode that has more than half of its
    kinetic energy in a rigid motion is left out. Springs so stiff that the body bends before it moves as a whole
    leave no such mode, and then none is left out. On a `support` they are modes like all others, but for turns about a
    patch that no spring opposes. With `perturbed` the
    modes come with the first-order changes of their matrices, for a body without factors.

    Raises SimulationError for a body of several parts or too few nodes, and for no mode.
    """
    assert not perturbed or (stiffness_factor is None and density_factor is None)
    light = solid.volumes.new_ones(len(solid.cells)) if density_factor is None else density_factor.double()
    mesh, forces, weights, shift = _matrices(solid, material, light, stiffness_factor)
    if springs is not None:
        forces = forces + _springs(mesh, *springs)
    if support is not None:
        forces = forces + support.springs(mesh)
    rigid = rigid_motions(mesh.nodes, weights)
    squares, shapes = lowest_vibrations(
        forces, weights, rigid if support is None else np.zeros_like(rigid), count=count, shift=shift,
        supported=springs is not None or support is not None,
    )  # fmt: skip
    total = float((solid.volumes * light).sum()) * material.density
    changes = perturbations(mesh, shapes.reshape(len(mesh.nodes), 3, -1), material) if perturbed else None
    return replace(_modes(mesh, material, total, squares, _at_surface(mesh, shapes)), perturbations=changes)


class HeldModes:
    """The modes of a body on any support of some patches, of one computation of its free ones."""

    def __init__(
        self, solid: Solid, material: Material, *, count: int = 64, patches: Sequence[Patch] | None = None
    ) -> None:
        """Compute the free modes and the responses to forces on the patches, by default `patches_of` the body.

        Raises SimulationError as `elastic_modes`, and for a body without a small part that it could be held at.
        """
        mesh, forces, weights, shift = _matrices(solid, material, solid.volumes.new_ones(len(solid.cells)), None)
        rigid = rigid_motions(mesh.nodes, weights)
        squares, shapes = lowest_vibrations(forces, weights, rigid, count=count, shift=shift, supported=False)
        self._count, self._modes = count, partial(_modes, mesh, material, float(solid.volumes.sum()) * material.density)
        self.free = self._modes(squares, _at_surface(mesh, shapes))
        self.patches = tuple(patches_of(mesh) if patches is None else patches)
        if not self.patches:
            raise SimulationError.expected("a part of the surface to hold it at", 0, got="none", name="patches")
        loads = [patch.loads(mesh) for patch in self.patches]
        stacked = scipy.sparse.hstack(loads, format="csc")
        # About the static response: the mass takes away what a free body does as a whole.
        responses = factorize(forces, weights, shift=0.5 * float(squares[0]))(stacked.toarray())
        known = np.concatenate([rigid, shapes], axis=1)
        basis = np.concatenate([known, orthonormal(responses, weights, known, least=_INDEPENDENT)[0]], axis=1)
        self._surface = _at_surface(mesh, basis)
        self._stiffness = basis.T @ (forces @ basis)
        # A rigid motion takes no force: what is there is rounding.
        still = rigid.shape[1]
        self._stiffness[:still] = self._stiffness[:, :still] = 0.0
        self._loads = np.split(stacked.T @ basis, np.cumsum([each.shape[1] for each in loads])[:-1])
        self.stiffness_scale = float(weights.sum()) * math.exp(float(np.log(squares).mean()))
        """The body's mass times the geometric mean of its squared angular frequencies, N/m."""

    def on(self, support: Support) -> ElasticModes:
        """Return the lowest modes on a support of some of the `patches`, as many as the free body has."""
        total = self._stiffness.copy()
        for patch in support.patches:
            loads = self._loads[self.patches.index(patch)]
            total += support.stiffness * loads.T @ loads
        squares, vectors = scipy.linalg.eigh(total, subset_by_index=(0, min(self._count + 5, len(total) - 1)))
        moving = np.flatnonzero(squares > PENDULUM * squares[-1])[: self._count]
        return self._modes(squares[moving], self._surface @ vectors[:, moving])


def _matrices(
    solid: Solid, material: Material, light: Float64[Tensor, " cells"], stiff: Float[Tensor, " cells"] | None
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
    material: Material,
    total: float,
    squares: Float64[np.ndarray, " modes"],
    shapes: Float64[np.ndarray, "outer_dofs modes"],
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


def _springs(mesh: SecondOrder, places: Float[Tensor, "springs 3"], strength: float) -> scipy.sparse.csr_array:
    """Return the stiffness that springs at the nearest points of the surface add, spread over a triangle's nodes."""
    triangles = mesh.boundary
    found = ClosestPoints(mesh.nodes[triangles[:, :3]])(places.double().numpy())
    parts = _quadratic(found).ravel(), triangles[found.rows].ravel(), 6 * np.arange(len(places) + 1)
    held = scipy.sparse.csr_array(parts, shape=(len(places), len(mesh.nodes)))
    return scipy.sparse.kron(strength * (held.T @ held), scipy.sparse.eye_array(3), format="csr")


def _quadratic(found: Closest) -> Float64[np.ndarray, "places 6"]:
    """Return the second-order shape functions of the nearest triangles in the nearest points of them."""
    corner = found.weights
    return np.concatenate([corner * (2.0 * corner - 1.0), 4.0 * corner * np.roll(corner, -1, axis=1)], axis=1)


_KIND = FileKind("avmsf_elastic", "elastic modes", "compute them again", SimulationError)
_PERTURBATIONS = ("stiffness", "mass", "poisson")


def mode_sizes(modes: ElasticModes) -> dict[str, int]:
    """Return the sizes of the tensors."""
    return {"nodes": len(modes.nodes), "triangles": len(modes.triangles), "shapes": len(modes)}


def mode_tensors(modes: ElasticModes) -> dict[str, Tensor]:
    """Return the tensors by name, as files of fields hold them."""
    named = {name: getattr(modes, name) for name in ("frequency", "nodes", "triangles")}
    return named | {"shapes": modes.shapes.float()}


def restored_modes(sizes: Mapping[str, Any], read: TensorReader) -> ElasticModes:
    """Return the modes, of the nominal material and no mass, of these sizes.

    Raises ValueError, TypeError or KeyError for what are no sizes, and ValueError for values that no modes have.
    """
    places, faces, modes = (count_of(sizes[name], name) for name in ("nodes", "triangles", "shapes"))
    frequency, nodes = read("frequency", modes), read("nodes", places, 3)
    rows, shapes = read("triangles", faces, 6, dtype=torch.int64), read("shapes", places, modes, 3, dtype=torch.float32)
    if not bool((frequency > 0).all()):
        raise ValueError(f"expected frequencies above 0, got {float(frequency.min()):g}")
    if not 0 <= int(rows.min()) <= int(rows.max()) < places:
        raise ValueError(
            f"expected corners of triangles from 0 to {places - 1}, got {int(rows.min())} to {int(rows.max())}"
        )
    return ElasticModes(frequency, nodes, rows, shapes.double(), NOMINAL, mass=0.0)


def modes_once(path: Path | None, compute: Callable[[], ElasticModes], *, log: Callable[[str], None]) -> ElasticModes:
    """Return the modes that `path` keeps, or compute them and keep them there, where that is possible; None keeps none.

    A damaged file is made again, and `log` is called. Raises as `compute`.
    """
    # Unlike Path.is_file, this is False where the folder cannot be read.
    if path is not None and os.path.isfile(path):
        try:
            return _read(path)
        except SimulationError as error:
            log(f"computing the modes again ({error})")
    modes = compute()
    if path is not None:
        tensors = mode_tensors(modes) | {"shapes": modes.shapes}
        if modes.perturbations is not None:
            tensors |= {name: torch.from_numpy(getattr(modes.perturbations, name)) for name in _PERTURBATIONS}
        header = json.dumps({"mass": modes.mass, "material": asdict(modes.material)}, allow_nan=False)
        keep_if_possible(lambda: write_tensors(path, tensors, header, _KIND), path)
    return modes


def _read(path: Path) -> ElasticModes:
    header, tensors = read_tensors(path, _KIND)
    try:
        record = parse_json(header)
        changes = {name: tensors.pop(name).numpy() for name in _PERTURBATIONS if name in tensors}
        return ElasticModes(
            **tensors, material=Material(**record["material"]), mass=float(record["mass"]),
            perturbations=Perturbations(**changes) if changes else None,
        )  # fmt: skip
    except (ValueError, TypeError, KeyError) as error:
        raise _KIND.damaged(path, error, name="modes") from error
