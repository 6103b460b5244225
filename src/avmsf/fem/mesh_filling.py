"""A checked surface as tetrahedra of a wanted number: what it encloses, or its wall."""

import contextlib
import math
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from avmsf.errors import SceneError, SimulationError
from avmsf.fem.elements import SecondOrder
from avmsf.fem.mesh_check import CheckedSurface, checked, simplified
from avmsf.fem.shell import shell
from avmsf.fem.skin import Skin
from avmsf.fem.solid import Solid
from avmsf.fem.tetrahedra import fill
from avmsf.fem.walls import wall_of
from avmsf.mesh.surface import Surface

FEWEST = 1000
"""Degrees of freedom below which no body has 20 modes worth the name."""
_OVER, _UNDER = 1.2, 0.65
"""Degrees of freedom over those wanted, from `_UNDER` to `_OVER`, that end the search."""
_PRISMS = 1.5
"""Degrees of freedom of prisms over those wanted, at most: a few more cost less than tetrahedra."""
_FILLING_SECONDS = 60.0
"""Time that one filling with tetrahedra may take; then coarser ones are tried once, and after that there is no body."""
_TRIES = 4
_POWER = 1.5
"""By which degrees of freedom go with the inverse of the detail."""
_STEP = 2.0
"""Largest factor on the detail from one try to the next. fTetWild's number of tetrahedra is erratic for few triangles:
17 to 88 thousand degrees of freedom for details of .03 and .04 of a block of twelve."""
_FINER = 0.6
"""Factor on a detail that is too coarse for a body."""
_DETAILS = (0.002, 0.4)
"""Least and most length of a tetrahedron's edges over the body's size."""
TRIANGLES = 0.1
"""Triangles that fill gets, over the degrees of freedom: fTetWild keeps their corners, so more of them make more
tetrahedra, and its time goes with them."""
_KNOTTED = 4.0
"""More triangles than that, over those that fill gets, only so that none share an edge among three, take more time than
the few that do harm the form: fTetWild allows them."""
_SHELL = 36.0
"""Degrees of freedom of a wall over the vertices of the skin that it follows."""
_PEAK = 377e6, 40_000, 1.1
"""Bytes that modes take at their peak, of how many degrees of freedom, and the power they grow by (benchmarks/fem)."""
_CAUTION = 2.0
"""Factor on that, for lumps take more than the walls it was measured on."""


@runtime_checkable
class Shape(Protocol):
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


def expect_memory(dofs: int) -> None:
    """Raise SimulationError where the modes of a mesh with so many degrees of freedom do not fit into memory."""
    free = _free_memory()
    peak, measured, power = _PEAK
    needed = _CAUTION * peak * (dofs / measured) ** power
    if free is not None and needed > free:
        fitting = int(measured * (free / (_CAUTION * peak)) ** (1.0 / power)) // 1000 * 1000
        raise SimulationError(
            f"expected about {needed / 1e9:.2g} GB of free memory for {dofs} degrees of freedom, got "
            f"{free / 1e9:.2g} GB; use {max(fitting, FEWEST)} (--body.dofs), or close other programs",
            name="memory",
            value=free,
        )


def count_dofs(solid: Solid) -> int:
    """Return the number of displacements at the nodes of second-order elements."""
    return 3 * len(SecondOrder.of(solid).nodes)


def filled_solid(checked: CheckedSurface, dofs: int, *, wall: float | None = None) -> Solid:
    """Return what a surface encloses as tetrahedra with about so many degrees of freedom.

    A mesh that shows both sides of a wall, which may be `wall` meters thick everywhere, is filled by prisms, one that
    has lumps too by tetrahedra. Raises SimulationError as `fill` does, for sheets, and where no detail comes near
    enough.
    """
    checked.expect_filling()
    sides = wall_of(checked.skin, wall)
    if sides is not None:
        with contextlib.suppress(SimulationError):
            # Degrees of freedom may be few for prisms along a wall that bends tightly; tetrahedra need not follow it.
            first = sides.length(dofs) / sides.size
            return _near(lambda detail: sides.solid(detail * sides.size), dofs, first=first, most=_PRISMS)
    first = _filling_detail(checked, dofs)

    def filled(detail: float) -> Solid:
        # Quadrics keep the volume. Edges taken out one by one made the wall of a mug 5 % thinner.
        count = round(TRIANGLES * dofs * (first / detail) ** 2)
        skin = simplified(checked.skin, count, most=_KNOTTED * count)
        return fill(_surface(skin), detail=detail, timeout=_FILLING_SECONDS)

    return _near(filled, dofs, first=first)


def walled_solid(shape: Shape, thickness: float, dofs: int, *, log: Callable[[str], None]) -> Solid:
    """Return the elements of a wall of a shape, meters thick. Raises SimulationError where it cannot be made."""
    try:
        surface = shape.shell(thickness, faces=round(0.5 * TRIANGLES * dofs))
    except SceneError as error:
        raise SimulationError(str(error), **error.attributes) from error
    return filled_solid(checked(surface, log=log), dofs, wall=thickness)


def wall_solids(checked: CheckedSurface, dofs: int) -> Callable[[float], Solid]:
    """Return what makes a wall of a thickness, meters, with about so many degrees of freedom inwards of a surface.

    The skin is remeshed once for all thicknesses. Raises SimulationError for several parts and for triangles that
    face different ways; what it returns does as `shell` does.
    """
    sheet = checked.sheet()
    length = 1.2 * math.sqrt(_SHELL * float(sheet.areas.sum()) / dofs)
    skin = sheet
    for _ in range(_TRIES):
        skin = sheet.remeshed(length)
        part = _SHELL * len(skin.points) / dofs
        if _UNDER <= part <= 1.0:
            break
        length *= math.sqrt(part / 0.85)
    surface = _surface(skin)

    def walled(thickness: float) -> Solid:
        def made(detail: float) -> Solid:
            return shell(surface, thickness=thickness, detail=detail)

        return _near(made, dofs, first=length / skin.size)

    return walled


def _near(make: Callable[[float], Solid], dofs: int, *, first: float, most: float = _OVER) -> Solid:
    """Return the solid of the detail, `first` at first, whose degrees of freedom come nearest to those wanted.

    Raises SimulationError where all of them are over by more than the factor `most`, and what `make` raises of the
    last detail where none was made.
    """
    tried: dict[float, int] = {}
    found: list[tuple[int, Solid]] = []
    for detail in _details(tried, dofs, first):
        try:
            solid = make(detail)
        except SimulationError as error:
            # Walls too thin for one detail may be thick enough for a finer one, and what takes too long may be coarser.
            if tried:
                break
            detail *= 1.0 / _FINER if error.name == "timeout" else _FINER
            solid = make(detail)
        tried[detail] = count_dofs(solid)
        found.append((tried[detail], solid))
    allowed = [each for each in found if each[0] <= most * dofs] or [min(found, key=itemgetter(0))]
    best = min(allowed, key=lambda each: abs(math.log(each[0] / dofs)))
    if best[0] > most * dofs:
        raise SimulationError(
            f"expected a mesh of {dofs} degrees of freedom, got {best[0]} at least; allow these (--body.dofs), or "
            "simplify the mesh",
            name="dofs",
            value=best[0],
        )
    return best[1]


def _details(tried: dict[float, int], dofs: int, first: float) -> Iterator[float]:
    """Yield details until one of those tried is near the wanted number: between two that enclose it once there are."""
    detail = min(max(first, _DETAILS[0]), _DETAILS[1])
    for _ in range(_TRIES):
        yield detail
        last, found = list(tried.items())[-1]
        if _UNDER * dofs <= found <= _OVER * dofs:
            return
        finer = max((each for each, count in tried.items() if count > dofs), default=None)
        coarser = min((each for each, count in tried.items() if count <= dofs), default=None)
        if finer is not None and coarser is not None:
            detail = math.sqrt(finer * coarser)
        else:
            change = (found / (0.95 * dofs)) ** (1.0 / _POWER)
            detail = min(max(last * min(max(change, 1.0 / _STEP), _STEP), _DETAILS[0]), _DETAILS[1])
        if detail in tried:
            return


def _filling_detail(checked: CheckedSurface, dofs: int) -> float:
    """Return a first guess of the detail that fills a surface with so many degrees of freedom."""
    skin = checked.skin
    held = checked.mean_thickness or 0.0
    area = float(skin.areas.sum())
    volume = 0.5 * held * area
    # Found by filling mugs, bowls, spoons and lumps: thin walls make tetrahedra smaller than asked for.
    lengths = np.geomspace(_DETAILS[0], _DETAILS[1], 200) * skin.size
    relative = np.maximum(held / lengths, 1e-3)
    needed = area / lengths**2 * 16.4 * relative**-0.68 + volume / lengths**3 * 38.0 * np.minimum(1.0, relative / 3.0)
    return float(lengths[np.argmax(needed <= dofs)] / skin.size) if (needed <= dofs).any() else _DETAILS[1]


def _surface(skin: Skin) -> Surface:
    return Surface(torch.from_numpy(skin.points).float(), torch.from_numpy(skin.faces))


def _free_memory() -> float | None:
    """Return the bytes of memory that programs can still have, or None where the system does not say."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return None
