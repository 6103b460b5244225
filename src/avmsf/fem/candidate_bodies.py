"""What may lie behind an object's surface, each candidate with the modes in which such a body would vibrate.

A surface does not say whether the object is solid, how thick its wall is or where it was held, all of which decide the
shapes of its modes. So several bodies are hypotheses, of few degrees of freedom, enough to choose by; the chosen one is
refined, other thicknesses and supports are computed when the recordings ask for them. Refinement, thicknesses and the
chosen support are calls of one function, `CandidateBodies.modes`, whose results are kept in memory and, by content, in
a folder. Supports are compared on a basis of few elements (`HeldModes`), which is not kept.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Literal, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from avmsf._utils.caching import content_digest, once, source_digest
from avmsf._utils.compiled import lane_count
from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import (
    MIN_DOFS,
    HollowShape,
    count_dofs,
    expect_memory,
    filled_solid,
    shape_solid,
    wall_solids,
)  # fmt: skip
from avmsf.fem.elastic_modes import ElasticModes, HeldModes, elastic_modes, modes_once
from avmsf.fem.material import MAX_FREQUENCY_ERROR, NOMINAL, Material
from avmsf.fem.meshing import CheckedSurface, checked, millimeters
from avmsf.fem.solid import Solid
from avmsf.fem.supports import Place, Support, patches_about
from avmsf.mesh.surface import Surface

Given = TypeVar("Given")
Made = TypeVar("Made")
Hypothesis = tuple[float | None, bool]
"""Thickness, meters, None for a solid body; and whether it goes all round its cavity."""
Supports = Literal["auto", "free", "try"]
"""Whether bodies are held: where the free one predicts little, never, or always tried."""
THICKNESS_RATIOS = tuple(float(ratio) for ratio in np.geomspace(0.003, 0.05, 6))
"""Thickness of walls that are tried, over the diagonal of the box around the surface."""
PRESENT_UNIT: Mapping[str, float] = MappingProxyType({"m": 1.0})
"""The only unit of a surface whose unit is known."""
COARSE_DOFS = 12_000
"""Degrees of freedom at most of each of several bodies."""
COARSE_WALL_DOFS = 22_000
"""Degrees of freedom at most of each of several walls of a shape: with 12,000 the log evidence of one thickness
varies by 15 nats from one mesh to the next, with 22,000 by about 3 (a mug)."""
_COMPARED = 8
"""Lowest frequencies that two meshes are compared by."""
_SHAPE_THICKNESSES = 5
"""Thicknesses that are computed at first of a shape whose wall is not known."""
_MEANS = frozenset({"memory", "timeout", "pytetwild"})
"""Names of errors that are no fault of a surface or its wall."""


@dataclass(frozen=True, eq=False)
class CandidateBody:
    """One hypothesis of what lies behind an object's surface, and how it would vibrate."""

    thickness: float | None
    """Thickness of its wall, meters; None for a solid body."""
    elastic: ElasticModes
    """Nominal material."""
    fine: bool = True
    """Whether its elements are as many as were asked for; of those that were made to be compared there are fewer."""
    support: Support | None = None
    """Where it is held; None for a free body."""
    updated: float | None = None
    """Log evidence (nats) that it gained by departures of its stiffness and density; None without."""
    closed: bool = False
    """Whether its wall goes all round a cavity without an opening, as it may where no view sees into one."""

    @property
    def name(self) -> str:
        """What it is, for people."""
        parts = [body_name(self.thickness, closed=self.closed), "" if self.support is None else self.support.name]
        parts.append("" if self.updated is None else "stiffness and density updated")
        return ", ".join(filter(None, parts))


def body_name(thickness: float | None, *, closed: bool = False) -> str:
    """Return what a body with a wall of this thickness, meters, is called; None is all that the surface encloses."""
    return "solid body" if thickness is None else f"{closed * 'closed '}wall of {millimeters(thickness, 2)}"


class CandidateBodies:
    """The bodies that may lie behind a surface, with the lowest `count` modes of each, made of `material`.

    `thicknesses` states what to try: walls in meters, None for what the surface encloses. By itself it tries that, and
    walls of `THICKNESS_RATIOS` times the surface's size where the surface is a sheet or holds much more than the wall
    would; of a `HollowShape`, walls all over its range of thickness. Where one body is left, it has about `dofs`
    degrees of freedom, at most a fifth more; of several each has at most `COARSE_DOFS`, or `COARSE_WALL_DOFS`, enough
    to choose by. Dense, noisy and inverted surfaces are repaired, and `log` is called with a note; the wall of an open
    one lies behind its triangles, whichever way they face. Modes are cached by content in the folder `cache`, for they
    take most of the time; a damaged file is made again.

    `supports` and `held_at`, points in meters, say whether and where the object was held. `unit_ratios` are the units
    that the surface may be in, with the lengths that it then has over those that it was read with, the present one
    first.

    Raises SimulationError for too few degrees of freedom. `bodies` raises it for a surface of points, and where no body
    can be had, with the reason for each: by the name "surface", or by that of the reason where only memory, time or the
    mesher stood against it.
    """

    def __init__(
        self,
        surface: Surface | HollowShape,
        *,
        thicknesses: Sequence[float | None] | None = None,
        supports: Supports = "free",
        held_at: Sequence[Place] = (),
        unit_ratios: Mapping[str, float] = PRESENT_UNIT,
        count: int = 80,
        dofs: int = 40_000,
        material: Material = NOMINAL,
        cache: Path | None = None,
        log: Callable[[str], None] | None = None,
    ) -> None:
        if dofs < MIN_DOFS:
            raise SimulationError.expected(f"{MIN_DOFS} or more", dofs, name="dofs")
        self.shape = None if isinstance(surface, Surface) else surface
        """The shape, where it is no surface."""
        self.supports, self.held_at, self.unit_ratios, self.dofs = supports, tuple(held_at), unit_ratios, dofs
        self._surface, self._log = surface, log or (lambda message: None)
        self._thicknesses, self._count, self._material, self._cache = thicknesses, count, material, cache
        self._coarse_dofs = min(dofs, COARSE_DOFS if self.shape is None else COARSE_WALL_DOFS)
        self._solved, self.solid = once(self._solve), once(self._make_solid)
        self._walls, self._remeshing = once(lambda dofs: wall_solids(self.checked, dofs)), Lock()

    @cached_property
    def bodies(self) -> tuple[CandidateBody, ...]:
        """The free bodies that can be had, at least one: the solid one first, then walls from thin to thick."""
        thicknesses = self._guesses() if self._thicknesses is None else self._thicknesses
        wanted: list[Hypothesis] = [(each, False) for each in dict.fromkeys(thicknesses)]
        refused: dict[Hypothesis, SimulationError] = {}

        def attempt(make: Callable[..., Made], wall: Hypothesis, **settings: bool) -> Made | None:
            try:
                return make(*wall, **settings)
            except SimulationError as error:
                refused[wall] = error
                return None

        for wall in wanted:
            attempt(self._expect_possible, wall)
        walls = [wall for wall in wanted if wall not in refused]
        fine = len(walls) == 1
        walls += [(each, True) for each, _ in walls if each is not None and self._closed is not None]
        made = _side_by_side(lambda wall: attempt(self._body, wall, fine=fine), walls)
        bodies = [body for body in made if body is not None]
        reasons = _grouped({wall: refused[wall] for wall in (*wanted, *walls) if wall in refused})
        if not bodies:
            causes = {str(error.name) for error in refused.values()}
            name = min(causes) if causes <= _MEANS else "surface"
            other = "another wall thickness, or none" if self._thicknesses else "the wall thickness in meters"
            wanted_body, got = "a surface with a finite-element model", f"none ({'; '.join(reasons)})"
            advice = f"repair the mesh, or give {other}"
            raise SimulationError.expected(wanted_body, reasons, got=got, name=name, advice=advice)
        for reason in reasons:
            self._log_refused(reason)
        return (self.refined(bodies[0]),) if len(bodies) == 1 else tuple(bodies)

    @property
    def searches_thickness(self) -> bool:
        """Whether there are several walls of no stated thickness."""
        return self._thicknesses is None and sum(body.thickness is not None for body in self.bodies) > 1

    @cached_property
    def checked(self) -> CheckedSurface:
        """What was seen of the object, repaired. Raises SimulationError as `meshing.checked`."""
        seen = self._surface if isinstance(self._surface, Surface) else self._surface.as_seen()
        return checked(seen, log=self._log)

    def modes(
        self,
        thickness: float | None,
        *,
        dofs: int | None = None,
        closed: bool = False,
        support: Support | None = None,
        perturbed: bool = True,
    ) -> ElasticModes:
        """Return the modes of one body, with about so many degrees of freedom; the same arguments compute them once.

        A `closed` wall goes all round its cavity. `perturbed` modes come with the first-order changes of their
        matrices. Raises SimulationError where there is no such body.
        """
        return self._solved(thickness, self.dofs if dofs is None else dofs, closed, support, perturbed)

    def refined(self, body: CandidateBody) -> CandidateBody:
        """Return a body computed with about all the degrees of freedom that were asked for; a fine one as it is.

        Where that fails, for want of memory or because it cannot be filled so finely, the coarser one is returned,
        which was good enough to choose by, and `log` is called with the reason.
        """

        def make() -> CandidateBody:
            if body.support is None:
                return self._body(body.thickness, body.closed, fine=True)
            elastic = self.modes(body.thickness, closed=body.closed, support=body.support)
            return replace(body, elastic=elastic, fine=True)

        return body if body.fine else self._attempt(f"{body.name}: using the coarse mesh", make) or body

    def held(self, body: CandidateBody) -> HeldModes | None:
        """Return the modes of a body on any support; None where they cannot be computed.

        Of tetrahedra that are few enough to choose by; `refined` makes the chosen body fine, without a check of its
        convergence. `log` is called with the reason for None.
        """

        def make() -> HeldModes:
            solid = self.solid(body.thickness, self._coarse_dofs, closed=body.closed)
            return HeldModes(solid, self._material, count=self._count, patches=patches_about(self.held_at) or None)

        return self._attempt(f"{body.name}: no supports tested", make)

    def with_thicknesses(self, body: CandidateBody, thicknesses: Sequence[float]) -> list[CandidateBody | None]:
        """Return bodies like another with walls so thick, meters, coarse as of several; None where that fails.

        `log` is called with the reasons, in the order of the thicknesses.
        """
        refused: dict[float, SimulationError | MemoryError] = {}

        def make(thickness: float) -> CandidateBody | None:
            try:
                return self._body(thickness, body.closed, fine=False)
            except (SimulationError, MemoryError) as error:
                refused[thickness] = error
                return None

        made = _side_by_side(make, thicknesses)
        for each in thicknesses:
            if each in refused:
                self._log_refused(f"{body_name(each, closed=body.closed)}: {refused[each]}")
        return made

    def _log_refused(self, reason: str) -> None:
        """Log why a body cannot be had, where there are others; without an error's name and advice."""
        self._log(f"not a candidate body: {reason.partition('; ')[0].replace(': wall: expected', ': expected')}")

    def _attempt(self, failure: str, make: Callable[[], Made]) -> Made | None:
        """Return what is made; None where that cannot be, which is logged after `failure`."""
        try:
            return make()
        except (SimulationError, MemoryError) as error:
            self._log(f"{failure}: {error}")
            return None

    @cached_property
    def _closed(self) -> HollowShape | None:
        """The shape without an opening, where no view sees into one."""
        return None if self.shape is None else self.shape.closed()

    def _guesses(self) -> list[float | None]:
        """Return the thicknesses to try; None for what the surface encloses."""
        if self.shape is None:
            return [None, *(ratio * self.checked.mesh.scale for ratio in THICKNESS_RATIOS)]
        between = self.shape.thickness_range
        return [None] if between is None else [None, *np.geomspace(*between, _SHAPE_THICKNESSES).tolist()]

    def _expect_possible(self, thickness: float | None, closed: bool) -> None:
        """Raise SimulationError where a body is out of the question before tetrahedra are made."""
        if thickness is None:
            self.checked.expect_filling()
        else:
            self.checked.expect_wall(thickness, guessed=self._thicknesses is None and self.shape is None)

    def _body(self, thickness: float | None, closed: bool, *, fine: bool) -> CandidateBody:
        """Return a free body with all degrees of freedom, or with few of them where it need not be fine."""
        if not fine and self.dofs > self._coarse_dofs:
            make = partial(self.modes, thickness, dofs=self._coarse_dofs, closed=closed, perturbed=False)
            # Thin walls are lost in few tetrahedra. A shape has other thicknesses, and the thinnest is a bound.
            coarse = make() if self.shape is not None else self._attempt("retrying with more tetrahedra", make)
            if coarse is not None:
                return CandidateBody(thickness, coarse, fine=False, closed=closed)
        # The thickness of a shape's wall is found with such elements, and makes up for their stiffness.
        if self.dofs > COARSE_DOFS and (self.shape is None or thickness is None):
            return CandidateBody(thickness, self._converged(thickness), closed=closed)
        return CandidateBody(thickness, self.modes(thickness, closed=closed), closed=closed)

    def _converged(self, thickness: float | None) -> ElasticModes:
        """Return the modes of one body, of twice the degrees of freedom where their frequencies still change much."""
        name, make = body_name(thickness), partial(self.modes, thickness, dofs=COARSE_DOFS, perturbed=False)
        with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(lane_count()) as pool:
            fine, check = pool.submit(self.modes, thickness), pool.submit(make)
            modes = fine.result()
        coarse = self._attempt(f"{name}: mesh convergence not checked", check.result)
        if coarse is None or (error := _frequency_error(coarse, modes)) <= MAX_FREQUENCY_ERROR:
            return modes
        finer = self._attempt(f"{name}: no finer mesh", partial(self.modes, thickness, dofs=2 * self.dofs))
        if finer is not None:
            modes, error = finer, _frequency_error(modes, finer)
        if error > MAX_FREQUENCY_ERROR:
            self._log(
                f"{name}: mesh too coarse, relative error of the lowest frequencies about {error:.0%}; "
                f"allow {4 * self.dofs} degrees of freedom (--set body.dofs=N)"
            )
        return modes

    def _solve(
        self, thickness: float | None, dofs: int, closed: bool, support: Support | None, perturbed: bool
    ) -> ElasticModes:
        """Return the modes of one body, read from the cache where they are there."""

        def compute() -> ElasticModes:
            solid = self.solid(thickness, dofs, closed=closed)
            size = count_dofs(solid)
            self._log(f"{self._count} elastic modes of {size} degrees of freedom")
            try:
                return elastic_modes(solid, self._material, count=self._count, support=support, perturbed=perturbed)
            except MemoryError as error:
                wanted = f"enough memory for {size} degrees of freedom"
                advice = f"use {max(dofs // 2, MIN_DOFS)} (--set body.dofs=N), or close other programs"
                raise SimulationError.expected(wanted, size, got="too little", name="dofs", advice=advice) from error

        if self._cache is None:
            return compute()
        surface = self._closed if closed else self._surface
        assert surface is not None
        values = {
            "wall": thickness, "dofs": dofs, "perturbed": perturbed, "count": self._count,
            "support": None if support is None else asdict(support), "material": asdict(self._material),
            "surface": surface.digest(), "version": version("avmsf"), "source": source_digest(__name__),
        }  # fmt: skip
        return modes_once(self._cache / f"nominal-{content_digest(values)[:24]}.safetensors", compute, log=self._log)

    def _make_solid(self, thickness: float | None, dofs: int, *, closed: bool = False) -> Solid:
        """Return about so many degrees of freedom of a wall of a thickness, meters, or of all that is enclosed."""
        expect_memory(dofs)
        self._log(f"dividing the {body_name(thickness, closed=closed)} into tetrahedra")
        if thickness is None:
            return filled_solid(self.checked, dofs)
        shape = self._closed if closed else self.shape
        if shape is None:
            # Threads that make several walls wait for the sheet that all of them follow.
            with self._remeshing:
                make = self._walls(dofs)
            return make(thickness)
        return shape_solid(shape, thickness, dofs, log=self._log)

    def digest(self) -> str:
        """Return a digest of the bodies."""
        settings = self.searches_thickness, self.supports, self.held_at, self.dofs, dict(self.unit_ratios)
        found = [(each.name, each.elastic.frequency, each.elastic.nodes, each.elastic.shapes) for each in self.bodies]
        return content_digest(settings, *chain.from_iterable(found))


def _side_by_side(make: Callable[[Given], Made], each: Sequence[Given]) -> list[Made]:
    """Return what is made of each, in threads.

    Most of the time goes to factorizations, which release the interpreter's lock and keep a processor busy each.
    """
    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(lane_count()) as pool:
        return list(pool.map(make, each))


def _frequency_error(coarse: ElasticModes, fine: ElasticModes) -> float:
    """Return an estimate of the largest relative error of the finer body's lowest frequencies (Richardson's).

    Errors go with the second power of the edges' length where facets cut off cross-section, and with the fourth where
    they lock; taken is the third. The number of nodes on the surface goes with the inverse of the second.
    """
    count = min(_COMPARED, len(coarse), len(fine))
    change = float((coarse.frequency[:count] / fine.frequency[:count] - 1.0).abs().max())
    return change / max((len(fine.nodes) / len(coarse.nodes)) ** 1.5 - 1.0, 1.0)


def _grouped(refused: Mapping[Hypothesis, SimulationError]) -> list[str]:
    """Return each reason once, after the names of all that it holds for."""
    names: dict[str, list[str]] = {}
    for (thickness, closed), error in refused.items():
        names.setdefault(str(error), []).append(body_name(thickness, closed=closed))
    shown = {reason: f"{each[0]} to {each[-1]}" if len(each) > 2 else ", ".join(each) for reason, each in names.items()}
    return [f"{each}: {reason}" for reason, each in shown.items()]
