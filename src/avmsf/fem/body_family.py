"""The bodies that one surface may enclose: a solid one, or walls of any thickness, of any isotropic material."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.candidate_bodies import WALL_TRIAL, WALLS
from avmsf.fem.isotropic import IsotropicModes, isotropic_modes
from avmsf.fem.mesh_check import CheckedSurface, checked
from avmsf.fem.mesh_filling import Shape, filled_solid, wall_solids, walled_solid
from avmsf.fem.solid import Solid
from avmsf.fem.walls import Wall, wall_of
from avmsf.mesh.surface import Surface

DOFS = WALL_TRIAL
"""Degrees of freedom of each wall, about: prisms along walls of a pot and a tube are 1 % too stiff in frequency."""
SOLID_DOFS = 40_000
"""Of a solid body, about: tetrahedra lock where they fill thin parts."""
_HOLES = 0.01
"""Part of a closed surface that lids over holes make up, below which the holes are defects of a scan. The mouth of a
bottle is about as much."""
_SCALES = (0.6, 0.85, 1.2, 1.7)
"""Thicknesses that are computed at first of a wall whose two sides are known, over that of the mesh. Scanners see the
inside of a vessel worse than its outside."""
_THICKNESSES = 6
"""Thicknesses that are computed at first of a shape whose wall is not known."""
_FINER = 0.7
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
        """Return the family with the body of another thickness, meters, too, which makes it exact there."""
        bodies = dict(zip(self.thickness, self.bodies, strict=True)) | {thickness: self.at(thickness)}
        ordered = tuple(sorted(bodies))
        return replace(self, thickness=ordered, bodies=tuple(bodies[each] for each in ordered))


def body_family(
    surface: Surface | Shape,
    *,
    count: int,
    dofs: int = DOFS,
    solid_dofs: int = SOLID_DOFS,
    log: Callable[[str], None] | None = None,
) -> BodyFamily:
    """Return the bodies of a surface, with their lowest `count` modes.

    Walls have about `dofs` degrees of freedom, a solid body `solid_dofs`.

    A closed mesh that shows both sides of one wall has walls of `_SCALES` times its thickness behind its larger side;
    another closed mesh is solid. An open mesh has walls of `WALLS` times its size. A shape from photographs has walls
    all over its range of thickness, or is solid where it has no cavity.

    Raises SimulationError for points without triangles, and where no body can be made, with the reason.
    """
    report = log or (lambda words: None)
    if not isinstance(surface, Surface):
        return _of_shape(surface, count, dofs, solid_dofs, report)
    found = checked(surface, log=report)
    if found.lids > _HOLES:
        make = wall_solids(found, dofs)
        thicknesses = [part * found.skin.size for part in WALLS if part * found.skin.size < found.width]
        return _of_walls(make, thicknesses, count, report)
    wall = wall_of(found.skin)
    scaled = None if wall is None else _scaled(wall, dofs)
    if wall is None or scaled is None:
        return _solid_body(found, count, solid_dofs, report)
    mean = wall.thickness
    return _of_walls(lambda thickness: scaled(thickness / mean), [mean * scale for scale in _SCALES], count, report)


def _of_shape(shape: Shape, count: int, dofs: int, solid_dofs: int, log: Callable[[str], None]) -> BodyFamily:
    between = shape.thickness_range
    if between is None:
        return _solid_body(checked(shape.as_seen(), log=log), count, solid_dofs, log)
    make = partial(walled_solid, shape, dofs=dofs, log=log)
    return _of_walls(make, np.geomspace(*between, _THICKNESSES).tolist(), count, log)


def _solid_body(found: CheckedSurface, count: int, dofs: int, log: Callable[[str], None]) -> BodyFamily:
    log("dividing the body into tetrahedra")
    return BodyFamily((isotropic_modes(filled_solid(found, dofs), count=count),), ())


def _of_walls(
    make: Callable[[float], Solid], thicknesses: list[float], count: int, log: Callable[[str], None]
) -> BodyFamily:
    """Return the bodies of those thicknesses, meters, that can be made."""
    made, reasons = {}, []
    for thickness in thicknesses:
        log(f"elastic modes of a wall of {1000 * thickness:.2g} mm")
        try:
            made[thickness] = isotropic_modes(make(thickness), count=count)
        except SimulationError as error:
            reasons.append(f"wall of {1000 * thickness:.2g} mm: {error}")
    if not made:
        raise SimulationError(
            f"expected a surface with a finite-element model, got none ({'; '.join(reasons)}); repair the mesh",
            name="surface",
            value=reasons,
        )
    return BodyFamily(tuple(made.values()), tuple(made), make)


def _scaled(wall: Wall, dofs: int) -> Callable[[float], Solid] | None:
    """Return what makes a wall of a factor times its thickness; None where prisms do not fill the mesh."""
    length = wall.length(dofs)
    for tried in (length, _FINER * length):
        try:
            return wall.solids(tried)
        except SimulationError:
            continue
    return None


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
