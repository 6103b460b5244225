"""Meshes that show both sides of a wall, against closed forms."""

import math

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import count_dofs, filled_solid
from avmsf.fem.candidate_bodies import SurfaceBodies
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.meshing import checked, weld
from avmsf.fem.walls import wall_of
from avmsf.mesh.surface import Surface
from avmsf.simulate.shapes import make_shape
from factories.looked_at import surface_of
from oracles.block import block


def box(*sides: float) -> Surface:
    """Twelve triangles."""
    return block(sides, (1, 1, 1)).surface


def tube(radius: float, wall: float, length: float, *, sides: int = 48, rings: int = 8) -> Surface:
    """A tube open at both ends, its wall's two sides and its rims meshed."""
    heights = np.linspace(0.0, length, rings)
    outer, inner = (np.stack([np.full(rings, radius + side * wall / 2), heights], axis=1) for side in (1, -1))
    return surface_of(trimesh.creation.revolve(np.concatenate([outer, inner[::-1], outer[:1]]), sections=sides))


def silent(words: str) -> None:
    """Nobody listens."""


def test_a_thin_tube_bends_like_a_ring():
    radius, wall = 0.05, 0.002
    solid = filled_solid(checked(tube(radius, wall, 0.15), log=silent), 15_000)
    lowest = float(elastic_modes(solid, STEEL, count=1).frequency[0])
    # Inextensional bending in two waves (Love, Mathematical Theory of Elasticity, art. 293, in plane strain).
    speed = math.sqrt(STEEL.young / (12 * STEEL.density * (1 - STEEL.poisson**2)))
    ring = 6 / math.sqrt(5) * wall / radius**2 * speed / (2 * math.pi)
    assert lowest == pytest.approx(ring, rel=0.04)


def test_facets_may_cut_across_a_wall_whose_thickness_is_known():
    radius, wall = 0.05, 0.001
    mesh = weld(tube(radius, wall, 0.15, sides=96, rings=16))
    unknown, known = wall_of(mesh), wall_of(mesh, wall)
    with pytest.raises(SimulationError):
        unknown.solid(unknown.length(9_000))
    lowest = float(elastic_modes(known.solid(known.length(9_000)), STEEL, count=1).frequency[0])
    speed = math.sqrt(STEEL.young / (12 * STEEL.density * (1 - STEEL.poisson**2)))
    assert lowest == pytest.approx(6 / math.sqrt(5) * wall / radius**2 * speed / (2 * math.pi), rel=0.04)


def test_prisms_fill_a_wall_of_uneven_thickness():
    shape = make_shape("tray", seed=14)
    mesh = weld(shape.surface)
    wall = wall_of(mesh)
    assert wall.thickness == pytest.approx(shape.thickness, rel=0.1)
    solid = wall.solid(wall.length(12_000))
    assert solid.volume == pytest.approx(mesh.volume, rel=0.02)
    assert count_dofs(solid) == pytest.approx(12_000, rel=0.35)


def test_a_mesh_with_three_triangles_at_an_edge_is_no_wall():
    surface = box(0.1, 0.06, 0.002)
    doubled = Surface(surface.vertices, torch.cat([surface.faces, surface.faces[:1]]))
    assert wall_of(weld(surface)) is not None
    assert wall_of(weld(doubled)) is None


@pytest.mark.parametrize("kind", ["blob", "mug"])
def test_lumps_and_walls_with_handles_are_not_filled_by_prisms(kind: str):
    wall = wall_of(weld(make_shape(kind, seed=1).surface))
    if wall is not None:
        with pytest.raises(SimulationError):
            wall.solid(wall.length(12_000))


def test_a_plate_of_twelve_triangles_has_leissas_frequencies():
    side, thickness = 0.2, 0.002
    body = SurfaceBodies(box(side, side, thickness), thicknesses=[None], count=3, dofs=12_000).bodies[0]
    rigidity = NOMINAL.young * thickness**3 / (12 * (1 - NOMINAL.poisson**2))
    found = 2 * math.pi * body.elastic.frequency * side**2 * math.sqrt(NOMINAL.density * thickness / rigidity)
    assert found.tolist() == pytest.approx([13.489, 19.789, 24.432], rel=0.01)


class Converging(SurfaceBodies):
    """Bodies whose frequencies' error falls with the third power of the edges' length."""

    def __init__(self, error: float) -> None:
        self.error, self.asked, self.messages = error, list[int](), list[str]()
        super().__init__(box(0.1, 0.1, 0.1), thicknesses=[None], count=8, dofs=40_000, log=self.messages.append)

    def modes(self, thickness: float | None, *, dofs: int = 40_000, **others: object) -> ElasticModes:
        self.asked.append(dofs)
        frequency = 100.0 * (1.0 + self.error * (40_000 / dofs) ** 1.5) * torch.arange(1, 9, dtype=torch.float64)
        nodes, none = torch.zeros(dofs, 3, dtype=torch.float64), torch.zeros(0, 6, dtype=torch.int64)
        return ElasticModes(frequency, nodes, none, torch.zeros(dofs, 8, 3, dtype=torch.float64), NOMINAL, 1.0)


@pytest.mark.parametrize(("error", "dofs", "told"), [(0.03, 40_000, 0), (0.08, 80_000, 0), (0.3, 80_000, 1)])
def test_a_body_of_too_coarse_elements_is_made_finer_and_an_error_that_is_left_told(error: float, dofs: int, told: int):
    made = Converging(error)
    assert made.bodies
    assert (max(made.asked), len(made.messages)) == (dofs, told)


@pytest.mark.slow
def test_the_stem_of_a_goblet_keeps_its_cross_section():
    shape = make_shape("goblet", seed=6)
    found, expected = (
        float(elastic_modes(solid, STEEL, count=1).frequency[0])
        for solid in (filled_solid(checked(shape.surface, log=silent), 20_000), shape.solid)
    )
    assert found == pytest.approx(expected, rel=0.08)
