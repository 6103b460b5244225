"""From an object's surface to the bodies that may lie behind it."""

from collections.abc import Callable
from pathlib import Path

from avmsf.capture.impacts import Impacts
from avmsf.capture.placement import expect_placed
from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import HollowShape
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.fem.material import NOMINAL, Material
from avmsf.mesh.surface import Surface, surface_points
from avmsf.pipeline.config import BodyConfig


def candidate_bodies(
    surface: Surface | HollowShape,
    config: BodyConfig | None = None,
    *,
    impacts: Impacts | None = None,
    material: Material = NOMINAL,
    cache: Path | None = None,
    log: Callable[[str], None] | None = None,
) -> SurfaceBodies:
    """Return the bodies that a surface may enclose; their mode shapes are cached by content in `cache`.

    Raises SimulationError where no body can be computed, with the name `wall` where `config` states one, and FitError,
    before any is, where the contacts of the `impacts` that they are meant for do not lie on the surface.
    """
    config = BodyConfig() if config is None else config
    seen = surface if isinstance(surface, Surface) else surface.as_seen()
    if impacts is not None:
        expect_placed(impacts.contacts, surface_points(seen), names=impacts.names)
    wall = config.wall
    try:
        bodies = SurfaceBodies(
            surface, thicknesses=None if wall is None else [wall or None], supports=config.supports,
            count=config.shapes, dofs=config.dofs, material=material, cache=cache, log=log,
        )  # fmt: skip
        # What cannot be had shows now.
        _ = bodies.bodies
    except SimulationError as error:
        if wall is None or error.name != "surface":
            raise
        extent = float((seen.vertices.amax(0) - seen.vertices.amin(0)).max())
        reasons = "; ".join(error.value) if isinstance(error.value, list) else str(error)
        wanted = f"a wall thickness in meters that an object of {extent:.3g} m can have"
        advice = "give it in meters, as 0.003 for 3 mm, or leave it out"
        if not wall:
            wanted, advice = "a closed mesh for 0, a solid body", "close the mesh, or give the wall thickness in meters"
        got = f"{wall:g} m ({reasons})"
        raise SimulationError.expected(f"{wanted}, as body.wall", wall, got=got, name="wall", advice=advice) from error
    return bodies
