"""From an object's surface to the bodies that may lie behind it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from avmsf.capture.impacts import Impacts
from avmsf.capture.placement import expect_placed, surface_points
from avmsf.errors import SimulationError
from avmsf.fem.candidate_bodies import NominalBody, Shape, nominal_bodies, refined, supported, with_wall
from avmsf.fem.supports import Support
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.mesh.surface import Surface
from avmsf.pipeline.config import BodyConfig


@dataclass(frozen=True, eq=False)
class FinerBodies:
    """Makes bodies of a surface finer, each once."""

    surface: Surface | Shape
    dofs: int
    """Degrees of freedom to come near to."""
    cache: Path | None
    """Folder that keeps elastic modes by content."""
    log: Callable[[str], None]
    """Told what is done, in words."""
    made: dict[tuple[float | None, Support | None], NominalBody] = field(default_factory=dict)
    """Those that are done, by their walls and supports: names of two may be alike."""

    def __call__(self, body: NominalBody) -> NominalBody:
        """Return the body with finer elements, or as it is where that fails: it was good enough to choose by."""
        key = body.wall, body.support
        if key not in self.made:
            self.made[key] = refined(self.surface, body, dofs=self.dofs, cache=self.cache, log=self.log)
        return self.made[key]

    def digest(self) -> str:
        """Return what tells these bodies from those of other settings."""
        return f"{self.dofs}"


@dataclass(frozen=True, eq=False)
class HeldBodies:
    """Holds bodies of a surface at what may have supported them, each once."""

    surface: Surface | Shape
    dofs: int
    """Degrees of freedom at most."""
    cache: Path | None
    """Folder that keeps elastic modes by content."""
    log: Callable[[str], None]
    """Told what is done, in words."""
    made: dict[float | None, tuple[NominalBody, ...]] = field(default_factory=dict)
    """Those that are done, by their walls."""

    def __call__(self, body: NominalBody) -> tuple[NominalBody, ...]:
        """Return the free body, and with each support that it may have."""
        if body.wall not in self.made:
            self.made[body.wall] = supported(self.surface, body, dofs=self.dofs, cache=self.cache, log=self.log)
        return self.made[body.wall]

    def digest(self) -> str:
        """Return what tells these bodies from those of other settings."""
        return f"{self.dofs}"


@dataclass(frozen=True, eq=False)
class ThickerBodies:
    """Gives a surface or shape walls of other thicknesses, each once."""

    surface: Surface | Shape
    count: int
    """Elastic modes."""
    dofs: int
    """Degrees of freedom at most."""
    cache: Path | None
    """Folder that keeps elastic modes by content."""
    log: Callable[[str], None]
    """Told what is done, in words."""
    made: dict[float, NominalBody | None] = field(default_factory=dict)
    """Those that are done, by their walls."""

    def __call__(self, wall: float) -> NominalBody | None:
        """Return the body with a wall of this thickness, meters; None where that fails."""
        if wall not in self.made:
            self.made[wall] = with_wall(
                self.surface, wall, count=self.count, dofs=self.dofs, cache=self.cache, log=self.log
            )
        return self.made[wall]

    def digest(self) -> str:
        """Return what tells these bodies from those of other settings."""
        return f"{self.dofs}"


def candidate_bodies(
    surface: Surface | Shape,
    config: BodyConfig | None = None,
    *,
    impacts: Impacts | None = None,
    cache: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> CandidateBodies:
    """Return the bodies that a surface may enclose; their mode shapes are cached by content in `cache`.

    Raises SimulationError where no body can be computed, with the name `wall` where `config` states one, and FitError,
    before any is, where the contacts of the `impacts` that they are meant for do not lie on the surface.
    """
    config = BodyConfig() if config is None else config
    if impacts is not None:
        seen = surface if isinstance(surface, Surface) else surface.as_seen()
        expect_placed(impacts.contacts, surface_points(seen), names=impacts.names)
    walls = None if config.wall is None else [config.wall or None]
    try:
        bodies = nominal_bodies(surface, walls=walls, count=config.shapes, dofs=config.dofs, cache=cache, log=log)
    except SimulationError as error:
        if config.wall is None or error.name != "surface":
            raise
        raise wall_error(surface, config.wall, error) from error
    made = surface, config.dofs, cache, log or (lambda words: None)
    several = config.wall is None and sum(body.wall is not None for body in bodies.bodies) > 1
    thicken = ThickerBodies(surface, config.shapes, *made[1:]) if several else None
    hold = None if config.supports == "free" else HeldBodies(*made)
    refine = None if len(bodies.bodies) == 1 and hold is None else FinerBodies(*made)
    return CandidateBodies(bodies, refine, hold, config.supports == "try", thicken)


def wall_error(surface: Surface | Shape, wall: float, error: SimulationError) -> SimulationError:
    """Return the error for a stated wall, meters, of which no body can be computed, with the reasons; 0 is solid."""
    seen = surface if isinstance(surface, Surface) else surface.as_seen()
    extent = float((seen.vertices.amax(0) - seen.vertices.amin(0)).max())
    reasons = "; ".join(error.value) if isinstance(error.value, list) else str(error)
    if not wall:
        wanted, advice = "a closed mesh for 0, a solid body", "close the mesh, or give the wall thickness in meters"
    else:
        wanted = f"a wall thickness in meters that an object of {extent:.3g} m can have"
        advice = "give it in meters, as 0.003 for 3 mm, or leave it out"
    return SimulationError(
        f"--body.wall: expected {wanted}, got {wall:g} m ({reasons}); {advice}", name="wall", value=wall
    )


def roughened(surface: Surface, part: float, *, seed: int) -> Surface:
    """Return a surface whose vertices are displaced at random, by `part` of its size (standard deviation, each axis).

    The size is the diagonal of the box around it: what a bad scan does to a shape.
    """
    generator = np.random.default_rng(seed)
    size = float((surface.vertices.amax(0) - surface.vertices.amin(0)).norm())
    moved = surface.vertices.double().numpy() + part * size * generator.standard_normal(surface.vertices.shape)
    return Surface(torch.from_numpy(moved).to(surface.vertices.dtype), surface.faces)
