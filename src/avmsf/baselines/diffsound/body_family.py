"""The bodies that one surface may enclose: a solid one, or walls of any thickness, of any isotropic material."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import HollowShape
from avmsf.fem.candidate_bodies import COARSE_WALL_DOFS, THICKNESS_RATIOS, CandidateBodies
from avmsf.fem.isotropic import IsotropicModes, isotropic_modes
from avmsf.fem.solid import Solid
from avmsf.fem.walls import wall_of
from avmsf.mesh.surface import Surface

_SOLID_DOFS = 40_000
"""Degrees of freedom of a solid body, about: tetrahedra lock where they fill thin parts."""
_MAX_DEFECT_LIDS = 0.01
"""Part of a closed surface that lids over holes make up, below which the holes are defects of a scan. The mouth of a
bottle is about as much."""
_WALL_RATIOS = (0.6, 0.85, 1.2, 1.7)
"""Thicknesses that are computed at first of a wall whose two sides are known, over that of the mesh. Scanners see the
inside of a vessel worse than its outside."""
_SHAPE_THICKNESSES = 6
"""Thicknesses that are computed at first of a shape whose wall is not known."""
_SAME_THICKNESS = 1e-3
"""Relative difference up to which two thicknesses count as one."""
_REFINEMENT = 0.7
"""Factor on the length of prisms that are too coarse for a mesh."""


@dataclass(frozen=True, eq=False)
class BodyFamily:
    """Free bodies with the same outer side, by the thickness of their walls.

    Between two thicknesses the logarithms of squared frequencies, in ascending order, are interpolated by a cubic in
    the logarithm of the thickness: bending of a thin wall goes with the thickness, stretching does not depend on it.
    """

    bodies: tuple[IsotropicModes, ...]
    """By ascending thickness."""
    thickness: tuple[float, ...]
    """Of their walls on average, meters; empty for a solid body, which is alone."""
    make: Callable[[float], Solid] | None = None
    """Makes the body of another thickness, meters; None for a solid body. Raises SimulationError where it cannot."""

    @property
    def walled(self) -> bool:
        """Whether there are walls of several thicknesses."""
        return len(self.thickness) > 1

    def squares(
        self, poisson: Float[Tensor, ""], log_thickness: Float[Tensor, ""] | None = None
    ) -> Float64[Tensor, " modes"]:
        """Return the squared angular frequencies for E / rho = 1 m2/s2, ascending; differentiable in both.

        `log_thickness` is the natural logarithm of meters; it is needed where there are several thicknesses, and
        limited to their range.
        """
        if not self.walled or log_thickness is None:
            return self.bodies[0].squares(poisson)
        knots = torch.tensor(self.thickness, dtype=torch.float64).log()
        place = log_thickness.double().clamp(knots[0], knots[-1])
        left = int(torch.searchsorted(knots, place.detach(), right=True).clamp(1, len(knots) - 1)) - 1
        near = range(max(0, left - 1), min(len(knots), left + 3))
        values = torch.stack([self.bodies[row].squares(poisson).log() for row in near])
        return _cubic(knots[list(near)], values, place, left - near[0]).exp()

    def at(self, thickness: float | None) -> IsotropicModes:
        """Return the body of one thickness, meters, computed where it is not among `bodies`.

        Raises SimulationError where it cannot be made.
        """
        if thickness is None or self.make is None or not self.walled:
            return self.bodies[0]
        for known, body in zip(self.thickness, self.bodies, strict=True):
            if math.isclose(known, thickness, rel_tol=1e-9):
                return body
        return isotropic_modes(self.make(thickness), count=self.bodies[0].count)

    def including(self, thickness: float) -> "BodyFamily":
        """Return the family with the body of another thickness, meters, too, which makes it exact there.

        The same where it has one next to it: the slope between the two would be that of their meshes' differences.
        """
        if any(math.isclose(known, thickness, rel_tol=_SAME_THICKNESS) for known in self.thickness):
            return self
        bodies = dict(zip(self.thickness, self.bodies, strict=True)) | {thickness: self.at(thickness)}
        ordered = tuple(sorted(bodies))
        return replace(self, thickness=ordered, bodies=tuple(bodies[each] for each in ordered))


def body_family(surface: Surface | HollowShape, *, count: int, dofs: int = COARSE_WALL_DOFS) -> BodyFamily:
    """Return the bodies of a surface, with their lowest `count` modes.

    Walls have about `dofs` degrees of freedom, a solid body 40,000: prisms along walls of a pot and a tube are
    1 % too stiff in frequency. A closed mesh that shows both sides of one wall has walls of `_WALL_RATIOS` times its
    thickness behind its larger side; another closed mesh is solid. An open mesh has walls of `THICKNESS_RATIOS` times
    its size. A shape from photographs has walls all over its range of thickness, or is solid where it has no cavity.

    Raises SimulationError for points without triangles, and where no body can be made, with the reason.
    """
    candidates = CandidateBodies(surface)
    thicknesses, make = _walls(candidates, dofs)
    if make is None:
        return BodyFamily((isotropic_modes(candidates.solid(None, _SOLID_DOFS), count=count),), ())
    made, reasons = {}, []
    for thickness in thicknesses:
        try:
            made[thickness] = isotropic_modes(make(thickness), count=count)
        except SimulationError as error:
            reasons.append(f"wall of {1000 * thickness:.2g} mm: {error}")
    if not made:
        wanted, got = "one with a finite-element model", f"none ({'; '.join(reasons)})"
        raise SimulationError.expected(wanted, reasons, got=got, name="surface", advice="repair the mesh")
    return BodyFamily(tuple(made.values()), tuple(made), make)


def _walls(candidates: CandidateBodies, dofs: int) -> tuple[list[float], Callable[[float], Solid] | None]:
    """Return the thicknesses of walls to compute, meters, and what makes them; nothing for a solid body."""
    if candidates.shape is not None:
        between = candidates.shape.thickness_range
        if between is None:
            return [], None
        return np.geomspace(*between, _SHAPE_THICKNESSES).tolist(), partial(candidates.solid, dofs=dofs)
    found = candidates.checked
    if found.lids > _MAX_DEFECT_LIDS:
        thicknesses = [ratio * found.mesh.scale for ratio in THICKNESS_RATIOS]
        return [each for each in thicknesses if each < found.width], partial(candidates.solid, dofs=dofs)
    wall = wall_of(found.mesh)
    if wall is not None:
        length = wall.length(dofs)
        for tried in (length, _REFINEMENT * length):
            with suppress(SimulationError):
                return [wall.thickness * ratio for ratio in _WALL_RATIOS], wall.solids(tried)
    return [], None


def _cubic(
    knots: Float64[Tensor, " knots"], values: Float64[Tensor, "knots modes"], place: Float64[Tensor, ""], left: int
) -> Float64[Tensor, " modes"]:
    """Return the cubic Hermite interpolation between the knots `left` and `left + 1`, slopes from their neighbors."""
    step = knots[left + 1] - knots[left]
    chord = (values[left + 1] - values[left]) / step

    def slope(row: int) -> Float64[Tensor, " modes"]:
        if row in (0, len(knots) - 1):
            return chord
        before, after = knots[row] - knots[row - 1], knots[row + 1] - knots[row]
        rising, next_rising = (values[row] - values[row - 1]) / before, (values[row + 1] - values[row]) / after
        return (after * rising + before * next_rising) / (before + after)

    part = (place - knots[left]) / step
    even = values[left] * (1.0 + 2.0 * part) * (1.0 - part) ** 2 + values[left + 1] * part**2 * (3.0 - 2.0 * part)
    return even + step * (slope(left) * part * (1.0 - part) ** 2 - slope(left + 1) * part**2 * (1.0 - part))
