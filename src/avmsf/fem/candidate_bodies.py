"""Guesses at what lies behind an object's surface, each with the shapes in which such a body would vibrate."""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from types import MappingProxyType

import numpy as np

from avmsf._utils.caching import key_of, source_digest
from avmsf._utils.compiled import lane_count
from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.elastic_store import modes_once
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import LARGEST_ERROR, NOMINAL, Material
from avmsf.fem.mesh_check import CheckedSurface, checked
from avmsf.fem.mesh_filling import FEWEST, Shape, count_dofs, expect_memory, filled_solid, wall_solids, walled_solid
from avmsf.fem.solid import Solid
from avmsf.fem.supports import Support, supports_of
from avmsf.mesh.surface import Surface

WALLS = tuple(float(part) for part in np.geomspace(0.003, 0.05, 6))
"""Thickness of walls that are tried, over the diagonal of the box around the surface."""
TRIAL = 12_000
"""Degrees of freedom at most of each of several bodies."""
WALL_TRIAL = 22_000
"""Degrees of freedom at most of each of several walls of a shape: with 12,000 the log evidence of one thickness
scatters by 15 nats from one mesh to the next, with 22,000 by about 3 (a mug)."""
_LOWEST = 8
"""Frequencies that are compared."""
_FORMAT = 3
"""Number of the way in which bodies are made; kept files of another are not read."""
_THICKNESSES = 5
"""Thicknesses that are computed at first of a shape whose wall is not known."""
_REMESHING = Lock()
"""Held while the skin of a wall is remeshed, which several threads wait for."""
_MEANS = frozenset({"memory", "timeout", "pytetwild"})
"""Names of errors that are no fault of a surface or its wall."""


@dataclass(frozen=True, eq=False)
class NominalBody:
    """One guess at what lies behind an object's surface, and how it would vibrate."""

    wall: float | None
    """Thickness of its wall, meters; None for a solid body."""
    elastic: ElasticModes
    """Nominal material."""
    fine: bool = True
    """Whether its elements are as many as were asked for; of those that were made to be compared there are fewer."""
    support: Support | None = None
    """Where it is held; None for a free body."""
    updated: float | None = None
    """Log evidence (nats) that it gained by departures of its stiffness and density; None without."""

    @property
    def name(self) -> str:
        """What it is, for people."""
        parts = [body_name(self.wall), "" if self.support is None else self.support.name]
        parts.append("" if self.updated is None else "stiffness and density updated")
        return ", ".join(filter(None, parts))


@dataclass(frozen=True, eq=False)
class NominalBodies:
    """All guesses from which modes could be computed."""

    bodies: tuple[NominalBody, ...]
    """At least one: the solid body first, then walls from thin to thick, or as the user states them."""
    refused: Mapping[float | None, str]
    """Reasons why others could not be had, by the others' walls: names of two may be alike."""


def nominal_bodies(
    surface: Surface | Shape,
    *,
    walls: Sequence[float | None] | None = None,
    count: int = 80,
    dofs: int = 40_000,
    material: Material = NOMINAL,
    cache: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> NominalBodies:
    """Return the bodies that may lie behind a surface, with the lowest `count` modes of each, made of `material`.

    `walls` states what to try: thicknesses in meters, None for what the surface encloses. By itself it tries that,
    and walls of `WALLS` times the surface's size where the surface is a sheet or holds much more than the wall would;
    of a `Shape`, walls all over its range of thickness. Where one body is left, it has about `dofs` degrees of
    freedom, at most a fifth more; of several each has at most `TRIAL`, or `WALL_TRIAL`, enough to choose by, and
    `BodyMaker.refine` makes the chosen one fine. Dense, noisy and inverted surfaces are repaired, and `log` is called
    with a note; the wall of an open one lies behind its triangles, whichever way they face. Modes are kept by content
    in the folder `cache`, for they take most of the time; a damaged file is made again.

    Raises SimulationError for a surface of points, and where no body can be had, with the reason for each: by the name
    "surface", or by that of the reason where only memory, time or the mesher stood against it.
    """
    maker = BodyMaker(surface, count=count, dofs=dofs, material=material, cache=cache, log=log)
    return maker.nominal(walls)


class BodyMaker:
    """Makes the bodies of one surface or shape, each once, and does once what all of them need.

    Arguments as those of `nominal_bodies`. Raises SimulationError for a count or degrees of freedom that cannot be.
    """

    def __init__(
        self,
        surface: Surface | Shape,
        *,
        count: int = 80,
        dofs: int = 40_000,
        material: Material = NOMINAL,
        cache: Path | None = None,
        log: Callable[[str], None] | None = None,
    ) -> None:
        for name, value, least in (("count", count, 1), ("dofs", dofs, FEWEST)):
            if value < least:
                raise SimulationError.expected(f"{least} or more", value, name=name)
        self._given = surface
        self._shape = None if isinstance(surface, Surface) else surface
        self._count, self._dofs, self._material, self._cache = count, dofs, material, cache
        self._log = log or (lambda words: None)
        self._trial = min(dofs, TRIAL if self._shape is None else WALL_TRIAL)
        self._walls: dict[int, Callable[[float], Solid]] = {}
        self._refined: dict[tuple[float | None, Support | None], NominalBody] = {}
        self._held: dict[float | None, tuple[NominalBody, ...]] = {}
        self._thickened: dict[float, NominalBody | None] = {}

    def nominal(self, walls: Sequence[float | None] | None) -> NominalBodies:
        """Return the bodies with these walls. Raises as `nominal_bodies`."""
        _expect_walls(walls)
        guessed = walls is None
        wanted: list[float | None] = self._guesses() if walls is None else list(dict.fromkeys(walls))
        refused: dict[float | None, SimulationError] = {}
        likely: list[float | None] = []
        for wall in wanted:
            try:
                self._expect_likely(wall, guessed=guessed)
                likely.append(wall)
            except SimulationError as error:
                refused[wall] = error
        bodies = self._bodies(likely, refused)
        reasons = _grouped(refused)
        if not bodies:
            causes = {str(error.name) for error in refused.values()}
            other = "give the wall thickness in meters" if guessed else "give another wall thickness, or none"
            raise SimulationError(
                f"expected a surface with a finite-element model, got none ({'; '.join(reasons)}); repair the mesh, or "
                f"{other}",
                name=min(causes) if causes <= _MEANS else "surface",
                value=reasons,
            )
        for reason in reasons:
            self._log(_without(reason))
        if len(bodies) == 1 and not bodies[0].fine:
            bodies = [self.refine(bodies[0])]
        return NominalBodies(tuple(bodies), MappingProxyType({wall: str(error) for wall, error in refused.items()}))

    def refine(self, body: NominalBody) -> NominalBody:
        """Return a body computed with about all the degrees of freedom that were asked for; a fine one as it is.

        Where that fails, for want of memory or because it cannot be filled so finely, the coarser one is returned,
        which was good enough to choose by, and `log` is called with the reason.
        """
        key = body.wall, body.support
        if body.fine or key in self._refined:
            return self._refined.get(key, body)
        try:
            if body.support is None:
                fine = self._body(body.wall, fine=True)
            else:
                fine = replace(body, elastic=self._modes(body.wall, self._dofs, body.support), fine=True)
        except SimulationError as error:
            self._log(f"{body.name}: using the coarse mesh: {error}")
            fine = body
        self._refined[key] = fine
        return fine

    def hold(self, body: NominalBody) -> tuple[NominalBody, ...]:
        """Return a free body, and held where an object may be: at its lowest face or point, or an edge.

        All have the same tetrahedra, of `TRIAL` or `WALL_TRIAL` degrees of freedom at most, enough to choose by;
        `refine` makes the chosen one fine, without a check of its convergence. Those whose modes cannot be computed are
        left out, and `log` is called with the reason; none are returned if the free one's cannot.
        """
        if body.wall not in self._held:
            self._held[body.wall] = tuple(self._supported(body))
        return self._held[body.wall]

    def thicken(self, wall: float) -> NominalBody | None:
        """Return the body with a wall of this thickness, meters, coarse as of several; None if that fails.

        `log` is called with the reason.
        """
        if wall not in self._thickened:
            try:
                self._thickened[wall] = self._body(wall, fine=False)
            except SimulationError as error:
                self._log(_without(f"{body_name(wall)}: {error}"))
                self._thickened[wall] = None
        return self._thickened[wall]

    def _supported(self, body: NominalBody) -> Iterator[NominalBody]:
        few, fine = self._trial, self._dofs <= self._trial
        try:
            solid = self._solid(body.wall, few)
            for support in (None, *supports_of(SecondOrder.of(solid))):
                try:
                    modes = self._modes(body.wall, few, support, perturbed=fine, solid=solid)
                    yield NominalBody(body.wall, modes, fine, support)
                except SimulationError as error:
                    if support is None:
                        raise
                    self._log(_without(f"{body.name}, {support.name}: {error}"))
        except SimulationError as error:
            self._log(f"{body.name}: no supports tested: {error}")

    @cached_property
    def _seen(self) -> Surface:
        return self._given if isinstance(self._given, Surface) else self._given.as_seen()

    @cached_property
    def _checked(self) -> CheckedSurface:
        """The surface, mended."""
        return checked(self._seen, log=self._log)

    def _guesses(self) -> list[float | None]:
        """Return the walls to try; None for what the surface encloses."""
        if self._shape is None:
            return [None, *(part * self._checked.skin.size for part in WALLS)]
        between = self._shape.thickness_range
        return [None] if between is None else [None, *np.geomspace(*between, _THICKNESSES).tolist()]

    def _expect_likely(self, wall: float | None, *, guessed: bool) -> None:
        """Raise SimulationError where a body is out of the question before tetrahedra are made."""
        if wall is None:
            self._checked.expect_filling()
        elif wall >= self._checked.width:
            raise SimulationError(
                f"expected a wall thinner than the object's width of {_millimeters(self._checked.width, 3)}, got "
                f"{_millimeters(wall, 3)}; give a thinner wall",
                name="wall",
                value=wall,
            )
        elif guessed and self._shape is None:
            self._checked.expect_hollow(wall)

    def _body(self, wall: float | None, *, fine: bool) -> NominalBody:
        """Return one body with so many degrees of freedom, or with few of them where it need not be fine."""
        if not fine and self._dofs > self._trial:
            try:
                return NominalBody(wall, self._modes(wall, self._trial, perturbed=False), fine=False)
            except SimulationError as error:
                # Thin walls are lost in few tetrahedra. A shape has other thicknesses, and the thinnest is a bound.
                if self._shape is not None:
                    raise
                self._log(f"retrying with more tetrahedra ({error})")
        return NominalBody(wall, self._converged(wall))

    def _bodies(self, walls: Sequence[float | None], refused: dict[float | None, SimulationError]) -> list[NominalBody]:
        """Return the bodies with these walls, fine if it is one; `refused` gets the errors of those that fail."""
        bodies = []
        # Most of the time goes to factorizations, which release the interpreter's lock and keep a processor busy each.
        with ThreadPoolExecutor(lane_count()) as pool:
            pending = {wall: pool.submit(self._body, wall, fine=len(walls) == 1) for wall in walls}
            try:
                for wall, body in pending.items():
                    try:
                        bodies.append(body.result())
                    except SimulationError as error:
                        refused[wall] = error
            finally:
                pool.shutdown(cancel_futures=True)
        return bodies

    def _converged(self, wall: float | None) -> ElasticModes:
        """Return modes of one body, of twice as many degrees of freedom where their frequencies still change much."""
        dofs = self._dofs
        modes = self._modes(wall, dofs)
        # The thickness of a shape's wall is found with such elements, and makes up for their stiffness.
        if dofs <= TRIAL or (self._shape is not None and wall is not None):
            return modes
        try:
            error = _frequency_error(self._modes(wall, TRIAL, perturbed=False), modes)
        except SimulationError as failure:
            self._log(f"{body_name(wall)}: mesh convergence not checked ({failure})")
            return modes
        if error > LARGEST_ERROR:
            try:
                finer = self._modes(wall, 2 * dofs)
                modes, error = finer, _frequency_error(modes, finer)
            except SimulationError as failure:
                self._log(f"{body_name(wall)}: no finer mesh ({failure})")
        if error > LARGEST_ERROR:
            self._log(
                f"{body_name(wall)}: mesh too coarse, relative error of the lowest frequencies about {error:.0%}; "
                f"allow {4 * dofs} degrees of freedom (--body.dofs)"
            )
        return modes

    def _modes(
        self,
        wall: float | None,
        dofs: int,
        support: Support | None = None,
        *,
        perturbed: bool = True,
        solid: Solid | None = None,
    ) -> ElasticModes:
        """Return the modes of one body, read from where they are kept; `solid` is known where others need it too."""

        def solved() -> ElasticModes:
            body = self._solid(wall, dofs) if solid is None else solid
            size = count_dofs(body)
            self._log(f"{self._count} elastic modes of {size} degrees of freedom")
            fixed = None if support is None else support.nodes(SecondOrder.of(body))
            try:
                return elastic_modes(body, self._material, count=self._count, fixed=fixed, perturbed=perturbed)
            except MemoryError as error:
                raise SimulationError(
                    f"expected enough memory for {size} degrees of freedom, got too little; use "
                    f"{max(dofs // 2, FEWEST)} (--body.dofs), or close other programs",
                    name="dofs",
                    value=size,
                ) from error

        return modes_once(self._kept(wall, dofs, support, perturbed=perturbed), solved, log=self._log)

    def _solid(self, wall: float | None, dofs: int) -> Solid:
        """Return tetrahedra with about so many degrees of freedom."""
        expect_memory(dofs)
        self._log(f"dividing the {body_name(wall)} into tetrahedra")
        if wall is None:
            return filled_solid(self._checked, dofs)
        if self._shape is not None:
            return walled_solid(self._shape, wall, dofs, log=self._log)
        with _REMESHING:
            if dofs not in self._walls:
                self._walls[dofs] = wall_solids(self._checked, dofs)
        return self._walls[dofs](wall)

    def _kept(self, wall: float | None, dofs: int, support: Support | None = None, *, perturbed: bool) -> Path | None:
        if self._cache is None:
            return None
        values = {
            "format": _FORMAT,
            "version": version("avmsf"),
            "source": source_digest(__name__),
            "surface": self._digest,
            "wall": wall,
            "count": self._count,
            "dofs": dofs,
            "perturbed": perturbed,
            "material": asdict(self._material),
            "support": None if support is None else asdict(support),
        }
        return self._cache / f"nominal-{key_of(values)}.safetensors"

    @cached_property
    def _digest(self) -> str:
        """Digest of the surface's vertices and triangles, or of the shape."""
        if self._shape is not None:
            return self._shape.digest()
        surface = self._seen
        vertices, faces = surface.vertices.double().cpu().numpy(), surface.faces.long().cpu().numpy()
        content = hashlib.sha256(f"{vertices.shape} {faces.shape}".encode())
        content.update(vertices.tobytes())
        content.update(faces.tobytes())
        return content.hexdigest()


def _frequency_error(coarse: ElasticModes, fine: ElasticModes) -> float:
    """Return an estimate of the largest relative error of the finer body's lowest frequencies (Richardson's).

    Errors go with the second power of the edges' length where facets cut off cross-section, and with the fourth where
    they lock; taken is the third. The number of nodes on the surface goes with the inverse of the second.
    """
    count = min(_LOWEST, len(coarse), len(fine))
    change = float((coarse.frequency[:count] / fine.frequency[:count] - 1.0).abs().max())
    return change / max((len(fine.nodes) / len(coarse.nodes)) ** 1.5 - 1.0, 1.0)


def _expect_walls(walls: Sequence[float | None] | None) -> None:
    if walls is not None and not len(walls):
        raise SimulationError.expected("thicknesses in meters, or None for a solid body", [], name="walls")
    for row, wall in enumerate(walls or ()):
        if wall is not None and not 0 < wall < float("inf"):
            raise SimulationError.expected("more than 0 m, or None for a solid body", wall, row=row, name="walls")


def _grouped(refused: Mapping[float | None, SimulationError]) -> list[str]:
    """Return each reason once, after the names of all that it holds for."""
    names: dict[str, list[str]] = {}
    for wall, error in refused.items():
        names.setdefault(str(error), []).append(body_name(wall))
    shown = {reason: f"{each[0]} to {each[-1]}" if len(each) > 2 else ", ".join(each) for reason, each in names.items()}
    return [f"{each}: {reason}" for reason, each in shown.items()]


def _without(reason: str) -> str:
    """Return the note of a body that cannot be had, where there are others; without an error's advice."""
    return f"not tried as the body: {reason.partition('; ')[0]}; the other candidates are compared"


def body_name(wall: float | None) -> str:
    """Return what a body of this wall, meters, is called, with two digits; None is all that the surface encloses."""
    return "solid body" if wall is None else f"wall of {_millimeters(wall, 2)}"


def _millimeters(meters: float, digits: int) -> str:
    """Return a length with so many significant digits and no exponent."""
    return f"{float(f'{1000 * meters:.{digits}g}'):g} mm"
