"""Tetrahedra of a wanted number: of what a surface encloses, or of a wall behind it.

The detail, the length of the elements' edges over the body's size, is searched by the degrees of freedom that it gives:
fTetWild's number of tetrahedra is erratic.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from avmsf.errors import SceneError, SimulationError
from avmsf.fem.elements import SecondOrder
from avmsf.fem.meshing import CheckedSurface, checked, simplified
from avmsf.fem.remeshing import remeshed, surface_of
from avmsf.fem.solid import Solid
from avmsf.fem.tetrahedra import TOLERANCES as FILLING
from avmsf.fem.tetrahedra import fill
from avmsf.fem.walls import shell, wall_of
from avmsf.mesh.surface import Surface

MIN_DOFS = 1000
"""Degrees of freedom below which no body has 20 modes worth the name."""
_TRIANGLES_PER_DOF = 0.1
"""Triangles that `fill` gets, over the degrees of freedom: its time and number of tetrahedra go with them."""


@dataclass(frozen=True)
class Tolerances:
    """How the detail is searched, and what modes take of the memory."""

    min_dofs_ratio: float = 0.65  # degrees of freedom over those wanted, from which on the search ends
    max_dofs_ratio: float = 1.2  # and up to which
    max_prism_dofs_ratio: float = 1.5  # likewise of prisms: a few more cost less than tetrahedra
    max_filling_seconds: float = 60.0  # of one filling with tetrahedra; then a coarser one is tried once
    max_tries: int = 4  # solids that are made
    dofs_power: float = 1.5  # by which degrees of freedom go with the inverse of the detail
    max_step: float = 2.0  # factor on the detail from one try to the next
    refinement: float = 0.6  # factor on a detail that is too coarse for a body
    min_detail: float = 0.002  # length of a tetrahedron's edges over the body's size
    max_detail: float = 0.4
    max_knotted_ratio: float = 4.0  # triangles over those that `fill` should get, for no edge to be shared among three
    wall_dofs_per_vertex: float = 36.0  # degrees of freedom of a wall over the vertices of the mesh that it follows
    peak_bytes: float = 377e6  # that the modes of `peak_dofs` take (benchmarks/proof.py)
    peak_dofs: int = 40_000
    peak_power: float = 1.1  # by which it grows with the degrees of freedom
    memory_safety: float = 2.0  # factor on that, for lumps take more than the walls it was measured on


TOLERANCES = Tolerances()


@runtime_checkable
class HollowShape(Protocol):
    """An object's shape as seen from outside, which a wall of any thickness may have."""

    @property
    def thickness_range(self) -> tuple[float, float] | None:
        """Least and largest thickness of a wall that is worth a trial, meters; None for an object without a cavity."""
        ...

    def as_seen(self) -> Surface:
        """Return the closed surface of what was seen, both sides of walls included."""
        ...

    def closed(self) -> "HollowShape | None":
        """Return the shape whose wall goes all round its cavity, without an opening; None where there can be none."""
        ...

    def shell(self, thickness: float, *, faces: int) -> Surface:
        """Return the closed surface of a wall, meters thick, behind the outer side. Raises SceneError without one.

        Each of its sides has about so many triangles.
        """
        ...

    def digest(self) -> str:
        """Return a digest of all that decides the surfaces."""
        ...


def count_dofs(solid: Solid) -> int:
    """Return the number of displacements at the nodes of second-order elements."""
    return 3 * len(SecondOrder.of(solid).nodes)


def filled_solid(surface: CheckedSurface, dofs: int, *, wall: float | None = None) -> Solid:
    """Return what a surface encloses as tetrahedra with about so many degrees of freedom.

    A mesh that shows both sides of a wall, which may be `wall` meters thick everywhere, is filled by prisms, one that
    has lumps too by tetrahedra. Raises SimulationError as `fill` does, for sheets, and where no detail comes near
    enough.
    """
    surface.expect_filling()
    sides = wall_of(surface.mesh, wall)
    if sides is not None:
        with contextlib.suppress(SimulationError):
            # Degrees of freedom may be few for prisms along a wall that bends tightly; tetrahedra need not follow it.
            size, most = sides.mesh.scale, TOLERANCES.max_prism_dofs_ratio
            first = sides.length(dofs) / size
            return _near(lambda detail: sides.solids(detail * size)(sides.thickness), dofs, first=first, most=most)
    first = _filling_detail(surface, dofs)

    def filled(detail: float) -> Solid:
        least = FILLING.envelope * detail * surface.mesh.scale
        if wall is not None and wall < least:
            # Nothing but crumbs would be left, after some seconds, of sides within reach of each other.
            advice = "allow more degrees of freedom (--set body.dofs=N)"
            raise SimulationError.expected(f"a wall of at least {least:.2g} m", wall, name="detail", advice=advice)
        # Quadrics keep the volume. Edges taken out one by one made the wall of a mug 5 % thinner.
        count = round(_TRIANGLES_PER_DOF * dofs * (first / detail) ** 2)
        mesh = simplified(surface.mesh, count, most=TOLERANCES.max_knotted_ratio * count)
        return fill(surface_of(mesh), detail=detail, timeout=TOLERANCES.max_filling_seconds)

    return _near(filled, dofs, first=first)


def shape_solid(shape: HollowShape, thickness: float, dofs: int, *, log: Callable[[str], None]) -> Solid:
    """Return the wall of a thickness, meters, that a shape may have. Raises SimulationError as `filled_solid`."""
    try:
        surface = shape.shell(thickness, faces=round(0.5 * _TRIANGLES_PER_DOF * dofs))
    except SceneError as error:
        raise SimulationError(str(error), **error.attributes) from error
    return filled_solid(checked(surface, log=log), dofs, wall=thickness)


def wall_solids(surface: CheckedSurface, dofs: int) -> Callable[[float], Solid]:
    """Return what makes a wall of a thickness, meters, inwards of a surface, which is remeshed once for all.

    Raises SimulationError for several parts and for triangles that face different ways; what it returns does as
    `shell` does.
    """
    sheet = surface.sheet()
    length = 1.2 * math.sqrt(TOLERANCES.wall_dofs_per_vertex * sheet.area / dofs)
    for _ in range(TOLERANCES.max_tries):
        mesh = remeshed(sheet, length)
        part = TOLERANCES.wall_dofs_per_vertex * len(mesh.vertices) / dofs
        if TOLERANCES.min_dofs_ratio <= part <= 1.0:
            break
        length *= math.sqrt(part / 0.85)
    wall, first = surface_of(mesh), length / mesh.scale
    return lambda thickness: _near(lambda detail: shell(wall, thickness=thickness, detail=detail), dofs, first=first)


def _near(make: Callable[[float], Solid], dofs: int, *, first: float, most: float = TOLERANCES.max_dofs_ratio) -> Solid:
    """Return the solid of the detail, `first` at first, whose degrees of freedom come nearest to those wanted.

    Raises SimulationError where all of them are over by more than the factor `most`, and what `make` raises of the
    last detail where none was made.
    """
    made: dict[float, tuple[int, Solid]] = {}
    detail: float | None = _bounded(first)
    while detail is not None and detail not in made and len(made) < TOLERANCES.max_tries:
        try:
            solid = make(detail)
        except SimulationError as error:
            # Walls too thin for one detail may be thick enough for a finer one, and what takes too long may be coarser.
            if made:
                break
            detail *= 1.0 / TOLERANCES.refinement if error.name == "timeout" else TOLERANCES.refinement
            solid = make(detail)
        made[detail] = count_dofs(solid), solid
        detail = _next_detail({each: count for each, (count, _) in made.items()}, dofs)
    allowed = [each for each in made.values() if each[0] <= most * dofs] or [min(made.values(), key=itemgetter(0))]
    best, solid = min(allowed, key=lambda each: abs(math.log(each[0] / dofs)))
    if best > most * dofs:
        wanted, got = f"a mesh of {dofs} degrees of freedom", f"{best} at least"
        advice = "allow these (--set body.dofs=N), or simplify the mesh"
        raise SimulationError.expected(wanted, best, got=got, name="dofs", advice=advice)
    return solid


def _next_detail(counts: dict[float, int], dofs: int) -> float | None:
    """Return the detail to try next, between two that enclose the wanted number once there are; None if it is near."""
    last, found = list(counts.items())[-1]
    if TOLERANCES.min_dofs_ratio * dofs <= found <= TOLERANCES.max_dofs_ratio * dofs:
        return None
    finer = max((each for each, count in counts.items() if count > dofs), default=None)
    coarser = min((each for each, count in counts.items() if count <= dofs), default=None)
    if finer is not None and coarser is not None:
        return math.sqrt(finer * coarser)
    change = (found / (0.95 * dofs)) ** (1.0 / TOLERANCES.dofs_power)
    return _bounded(last * min(max(change, 1.0 / TOLERANCES.max_step), TOLERANCES.max_step))


def _bounded(detail: float) -> float:
    return min(max(detail, TOLERANCES.min_detail), TOLERANCES.max_detail)


def _filling_detail(surface: CheckedSurface, dofs: int) -> float:
    """Return a first guess of the detail that fills a surface with so many degrees of freedom."""
    size, held, area = surface.mesh.scale, surface.mean_thickness or 0.0, surface.mesh.area
    volume = 0.5 * held * area
    # Found by filling mugs, bowls, spoons and lumps: thin walls make tetrahedra smaller than asked for.
    lengths = np.geomspace(TOLERANCES.min_detail, TOLERANCES.max_detail, 200) * size
    relative = np.maximum(held / lengths, 1e-3)
    needed = area / lengths**2 * 16.4 * relative**-0.68 + volume / lengths**3 * 38.0 * np.minimum(1.0, relative / 3.0)
    return float(lengths[np.argmax(needed <= dofs)] / size) if (needed <= dofs).any() else TOLERANCES.max_detail


def expect_memory(dofs: int) -> None:
    """Raise SimulationError where the modes of a mesh with so many degrees of freedom do not fit into memory."""
    free, peak = free_memory(), TOLERANCES.memory_safety * TOLERANCES.peak_bytes
    needed = peak * (dofs / TOLERANCES.peak_dofs) ** TOLERANCES.peak_power
    if free is not None and needed > free:
        fitting = int(TOLERANCES.peak_dofs * (free / peak) ** (1.0 / TOLERANCES.peak_power)) // 1000 * 1000
        wanted = f"about {needed / 1e9:.2g} GB of it free for {dofs} degrees of freedom"
        advice = f"use {max(fitting, MIN_DOFS)} (--set body.dofs=N), or close other programs"
        raise SimulationError.expected(wanted, free, got=f"{free / 1e9:.2g} GB", name="memory", advice=advice)


def free_memory() -> float | None:
    """Return the bytes of memory that programs can still have, or None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
