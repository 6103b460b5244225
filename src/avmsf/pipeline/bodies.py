"""From an object's surface to the bodies that may lie behind it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from avmsf.capture.impacts import Impacts
from avmsf.capture.placement import expect_placed
from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import HollowShape
from avmsf.fem.candidate_bodies import CandidateBodies, SurfaceBodies
from avmsf.mesh.surface import Surface, surface_points
from avmsf.pipeline.config import BodyConfig


def candidate_bodies(
    surface: Surface | HollowShape,
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
    try:
        bodies = SurfaceBodies(
            surface, thicknesses=None if config.wall is None else [config.wall or None], supports=config.supports,
            count=config.shapes, dofs=config.dofs, cache=cache, log=log,
        )  # fmt: skip
        # What cannot be had shows now.
        _ = bodies.bodies
    except SimulationError as error:
        if config.wall is None or error.name != "surface":
            raise
        raise wall_error(surface, config.wall, error) from error
    return bodies


def wall_error(surface: Surface | HollowShape, wall: float, error: SimulationError) -> SimulationError:
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
        f"body.wall: expected {wanted}, got {wall:g} m ({reasons}); {advice}", name="wall", value=wall
    )


def roughened(surface: Surface, part: float, *, seed: int) -> Surface:
    """Return a surface whose vertices are displaced at random, by `part` of its size (standard deviation, each axis).

    The size is the diagonal of the box around it: what a bad scan does to a shape.
    """
    generator = np.random.default_rng(seed)
    size = float((surface.vertices.amax(0) - surface.vertices.amin(0)).norm())
    moved = surface.vertices.double().numpy() + part * size * generator.standard_normal(surface.vertices.shape)
    return Surface(torch.from_numpy(moved).to(surface.vertices.dtype), surface.faces)
