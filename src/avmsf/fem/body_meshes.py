"""Tetrahedra of a wanted number: of what a surface encloses, or of a wall behind it."""

import contextlib
import math
from collections.abc import Callable
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from threading import Lock
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from trimesh import Trimesh

from avmsf._utils.caching import once
from avmsf.errors import SceneError, SimulationError
from avmsf.fem.elements import SecondOrder
from avmsf.fem.mesh_check import CheckedSurface, checked, simplified
from avmsf.fem.remeshing import remeshed
from avmsf.fem.solid import Solid
from avmsf.fem.tetrahedra import fill
from avmsf.fem.walls import shell, wall_of
from avmsf.mesh.surface import Surface

MIN_DOFS = 1000
"""Degrees of freedom below which no body has 20 modes worth the name."""
_OVER, _UNDER = 1.2, 0.65
"""Degrees of freedom over those wanted, from `_UNDER` to `_OVER`, that end the search."""
_PRISMS = 1.5
"""Degrees of freedom of prisms over those wanted, at most: a few more cost less than tetrahedra."""
_FILLING_SECONDS = 60.0
"""Time that one filling with tetrahedra may take; then a coarser one is tried once."""
_TRIES = 4
_POWER = 1.5
"""By which degrees of freedom go with the inverse of the detail."""
_STEP = 2.0
"""Largest factor on the detail from one try to the next: fTetWild's number of tetrahedra is erratic."""
_FINER = 0.6
"""Factor on a detail that is too coarse for a body."""
_DETAILS = (0.002, 0.4)
"""Least and most length of a tetrahedron's edges over the body's size."""
TRIANGLES = 0.1
"""Triangles that `fill` gets, over the degrees of freedom: its time and number of tetrahedra go with them."""
_KNOTTED = 4.0
"""Most triangles, over those that `fill` should get, that are worth it for no edge to be shared among three."""
_SHELL = 36.0
"""Degrees of freedom of a wall over the vertices of the mesh that it follows."""
_PEAK = 377e6, 40_000, 1.1
"""Bytes that modes take at their peak, of how many degrees of freedom, and the power they grow by (benchmarks/fem)."""
_CAUTION = 2.0
"""Factor on that, for lumps take more than the walls it was measured on."""


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


class BodyMeshes:
    """Makes the tetrahedra of the bodies that one surface, or one shape, may hide; what all of them need is made once.

    `log` is called with what was repaired in the surface, and with what is missing of it.
    """

    def __init__(self, surface: Surface | HollowShape, *, log: Callable[[str], None]) -> None:
        self.shape = None if isinstance(surface, Surface) else surface
        self.seen = surface if isinstance(surface, Surface) else surface.as_seen()
        """What was seen of the object, both sides of walls included."""
        self.digest = surface.digest()
        self._log, self._walls, self._remeshing = log, once(self._make_walls), Lock()

    @cached_property
    def checked(self) -> CheckedSurface:
        """The surface, repaired. Raises SimulationError as `mesh_check.checked`."""
        return checked(self.seen, log=self._log)

    def expect_possible(self, thickness: float | None, *, guessed: bool) -> None:
        """Raise SimulationError where a body is out of the question before tetrahedra are made.

        A `guessed` wall is so in a surface that holds little more than the wall would.
        """
        if thickness is None:
            self.checked.expect_filling()
        elif thickness >= self.checked.width:
            wanted = f"a thickness below the object's width of {millimeters(self.checked.width, 3)}"
            got, advice = millimeters(thickness, 3), "give a thinner wall"
            raise SimulationError.expected(wanted, thickness, got=got, name="wall", advice=advice)
        elif guessed and self.shape is None:
            self.checked.expect_hollow(thickness)

    def solid(self, thickness: float | None, dofs: int) -> Solid:
        """Return about so many degrees of freedom of a wall of a thickness, meters, or of all that is enclosed (None).

        Raises SimulationError where that cannot be made.
        """
        if thickness is None:
            return filled_solid(self.checked, dofs)
        if self.shape is None:
            return self.walls(dofs)(thickness)
        try:
            surface = self.shape.shell(thickness, faces=round(0.5 * TRIANGLES * dofs))
        except SceneError as error:
            raise SimulationError(str(error), **error.attributes) from error
        return filled_solid(checked(surface, log=self._log), dofs, wall=thickness)

    def walls(self, dofs: int) -> Callable[[float], Solid]:
        """Return what makes a wall of a thickness, meters, inwards of the surface, which is remeshed once for all.

        Raises SimulationError for several parts and for triangles that face different ways; what it returns does as
        `shell` does.
        """
        # Threads that make several walls wait for the skin that all of them follow.
        with self._remeshing:
            return self._walls(dofs)

    def _make_walls(self, dofs: int) -> Callable[[float], Solid]:
        sheet = self.checked.sheet()
        length = 1.2 * math.sqrt(_SHELL * sheet.area / dofs)
        mesh = sheet
        for _ in range(_TRIES):
            mesh = remeshed(sheet, length)
            part = _SHELL * len(mesh.vertices) / dofs
            if _UNDER <= part <= 1.0:
                break
            length *= math.sqrt(part / 0.85)
        surface, first = _surface(mesh), length / mesh.scale
        return lambda thickness: _near(
            lambda detail: shell(surface, thickness=thickness, detail=detail), dofs, first=first
        )


def millimeters(meters: float, digits: int) -> str:
    """Return a length with so many significant digits and no exponent."""
    return f"{float(f'{1000 * meters:.{digits}g}'):g} mm"


def filled_solid(checked: CheckedSurface, dofs: int, *, wall: float | None = None) -> Solid:
    """Return what a surface encloses as tetrahedra with about so many degrees of freedom.

    A mesh that shows both sides of a wall, which may be `wall` meters thick everywhere, is filled by prisms, one that
    has lumps too by tetrahedra. Raises SimulationError as `fill` does, for sheets, and where no detail comes near
    enough.
    """
    checked.expect_filling()
    sides = wall_of(checked.mesh, wall)
    if sides is not None:
        with contextlib.suppress(SimulationError):
            # Degrees of freedom may be few for prisms along a wall that bends tightly; tetrahedra need not follow it.
            size = sides.mesh.scale
            return _near(lambda detail: sides.solid(detail * size), dofs, first=sides.length(dofs) / size, most=_PRISMS)
    first = _filling_detail(checked, dofs)

    def filled(detail: float) -> Solid:
        # Quadrics keep the volume. Edges taken out one by one made the wall of a mug 5 % thinner.
        count = round(TRIANGLES * dofs * (first / detail) ** 2)
        mesh = simplified(checked.mesh, count, most=_KNOTTED * count)
        return fill(_surface(mesh), detail=detail, timeout=_FILLING_SECONDS)

    return _near(filled, dofs, first=first)


def _near(make: Callable[[float], Solid], dofs: int, *, first: float, most: float = _OVER) -> Solid:
    """Return the solid of the detail, `first` at first, whose degrees of freedom come nearest to those wanted.

    Raises SimulationError where all of them are over by more than the factor `most`, and what `make` raises of the
    last detail where none was made.
    """
    counts: dict[float, int] = {}
    made: list[tuple[int, Solid]] = []
    detail: float | None = min(max(first, _DETAILS[0]), _DETAILS[1])
    while detail is not None and detail not in counts and len(made) < _TRIES:
        try:
            solid = make(detail)
        except SimulationError as error:
            # Walls too thin for one detail may be thick enough for a finer one, and what takes too long may be coarser.
            if made:
                break
            detail *= 1.0 / _FINER if error.name == "timeout" else _FINER
            solid = make(detail)
        counts[detail] = count_dofs(solid)
        made.append((counts[detail], solid))
        detail = _next_detail(counts, dofs)
    allowed = [each for each in made if each[0] <= most * dofs] or [min(made, key=itemgetter(0))]
    best, solid = min(allowed, key=lambda each: abs(math.log(each[0] / dofs)))
    if best > most * dofs:
        got, advice = f"{best} at least", "allow these (--set body.dofs=N), or simplify the mesh"
        raise SimulationError.expected(
            f"a mesh of {dofs} degrees of freedom", best, got=got, name="dofs", advice=advice
        )
    return solid


def _next_detail(counts: dict[float, int], dofs: int) -> float | None:
    """Return the detail to try next, between two that enclose the wanted number once there are; None if it is near."""
    last, found = list(counts.items())[-1]
    if _UNDER * dofs <= found <= _OVER * dofs:
        return None
    finer = max((each for each, count in counts.items() if count > dofs), default=None)
    coarser = min((each for each, count in counts.items() if count <= dofs), default=None)
    if finer is not None and coarser is not None:
        return math.sqrt(finer * coarser)
    change = (found / (0.95 * dofs)) ** (1.0 / _POWER)
    return min(max(last * min(max(change, 1.0 / _STEP), _STEP), _DETAILS[0]), _DETAILS[1])


def _filling_detail(checked: CheckedSurface, dofs: int) -> float:
    """Return a first guess of the detail that fills a surface with so many degrees of freedom."""
    size, held, area = checked.mesh.scale, checked.mean_thickness or 0.0, checked.mesh.area
    volume = 0.5 * held * area
    # Found by filling mugs, bowls, spoons and lumps: thin walls make tetrahedra smaller than asked for.
    lengths = np.geomspace(_DETAILS[0], _DETAILS[1], 200) * size
    relative = np.maximum(held / lengths, 1e-3)
    needed = area / lengths**2 * 16.4 * relative**-0.68 + volume / lengths**3 * 38.0 * np.minimum(1.0, relative / 3.0)
    return float(lengths[np.argmax(needed <= dofs)] / size) if (needed <= dofs).any() else _DETAILS[1]


def _surface(mesh: Trimesh) -> Surface:
    return Surface(torch.from_numpy(np.array(mesh.vertices)).float(), torch.from_numpy(np.array(mesh.faces)))


def expect_memory(dofs: int) -> None:
    """Raise SimulationError where the modes of a mesh with so many degrees of freedom do not fit into memory."""
    free = _free_memory()
    peak, measured, power = _PEAK
    needed = _CAUTION * peak * (dofs / measured) ** power
    if free is not None and needed > free:
        fitting = int(measured * (free / (_CAUTION * peak)) ** (1.0 / power)) // 1000 * 1000
        wanted = f"about {needed / 1e9:.2g} GB of it free for {dofs} degrees of freedom"
        advice = f"use {max(fitting, MIN_DOFS)} (--set body.dofs=N), or close other programs"
        raise SimulationError.expected(wanted, free, got=f"{free / 1e9:.2g} GB", name="memory", advice=advice)


def _free_memory() -> float | None:
    """Return the bytes of memory that programs can still have, or None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
