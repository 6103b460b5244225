"""Bodies that are held at patches of their surface, and meshes that show both sides of a wall, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import brentq

from avmsf.errors import SimulationError
from avmsf.fem.body_meshes import count_dofs, filled_solid
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.fem.elastic_modes import ElasticModes, HeldModes, elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.meshing import checked, weld
from avmsf.fem.solid import Solid
from avmsf.fem.supports import Patch, Support, patches_of
from avmsf.fem.walls import wall_of
from avmsf.mesh.surface import Surface
from avmsf.simulate.shapes import make_shape
from factories.looked_at import surface_of
from factories.raising import raises
from oracles.block import block

RIGID = 1e12


def springed_beam(ratio: float) -> list[float]:
    """Wave numbers times length of a beam between two springs, each `ratio` times as stiff as E I / length^3.

    The textbook's boundary conditions at both ends: no moment, and a shear that is the spring's force.
    """

    def determinant(x: float) -> float:
        rows = []
        for place, sign in ((0.0, 1.0), (x, -1.0)):
            c, s, ch, sh = math.cos(place), math.sin(place), math.cosh(place), math.sinh(place)
            shape, moment, shear = np.array([c, s, ch, sh]), np.array([-c, -s, ch, sh]), np.array([s, -c, sh, ch])
            rows += [moment, x**3 * shear + sign * ratio * shape]
        return float(np.linalg.det(np.array(rows) / np.cosh(x)))

    grid = np.linspace(0.3, 12.0, 2000)
    values = [determinant(x) for x in grid]
    return [brentq(determinant, *grid[k : k + 2]) for k in range(len(grid) - 1) if values[k] * values[k + 1] < 0]


@pytest.mark.parametrize("ratio", [3.0, 100.0, 3000.0])
def test_a_beam_on_two_springs_has_the_textbooks_frequencies(ratio: float):
    length, width, height = 0.3, 0.012, 0.003
    solid = block((length, width, height), (30, 2, 1))
    stiffness = ratio * NOMINAL.young * width * height**3 / 12 / length**3
    ends = tuple(Patch(name, (way, 0.0, 0.0)) for name, way in (("left", -1.0), ("right", 1.0)))
    modes = elastic_modes(solid, NOMINAL, count=24, support=Support(ends, stiffness))
    middle = torch.tensor([[0.5 * length, 0.5 * width, 0.0]], dtype=torch.float64)
    line = middle + torch.linspace(-0.5, 0.5, 31, dtype=torch.float64)[:, None] * torch.tensor([length, 0.0, 0.0])
    along = modes.at(line).abs().amax(0)
    flexural = modes.frequency[along[:, 2] > 0.5 * modes.shapes.abs().amax((0, 2))]
    bending = math.sqrt(NOMINAL.young * height**2 / 12 / NOMINAL.density) / (2 * math.pi * length**2)
    expected = [x**2 * bending for x in springed_beam(ratio)[:4]]
    assert flexural[:4].tolist() == pytest.approx(expected, rel=0.02)


def test_a_body_on_a_soft_patch_bounces_as_a_rigid_one():
    solid = block((0.04, 0.03, 0.02), (4, 3, 2))
    stiffness = 100.0
    lowest = Patch("its lowest part", (0.0, 0.0, -1.0))
    modes = elastic_modes(solid, NOMINAL, count=6, support=Support((lowest,), stiffness))
    bounce = math.sqrt(stiffness / (NOMINAL.density * 0.04 * 0.03 * 0.02)) / (2 * math.pi)
    assert float((modes.frequency / bounce - 1).abs().min()) < 1e-3


def test_a_clamped_square_plate_has_leissas_frequencies():
    side, height = 0.2, 0.002
    steel = replace(NOMINAL, poisson=0.3)
    clamped = Support((Patch("a side", (0.0, 1.0, 0.0)),), RIGID)
    modes = elastic_modes(block((side, side, height), (14, 14, 1)), steel, count=5, support=clamped)
    rigidity = steel.young * height**3 / 12 / (1 - 0.3**2)
    unit = math.sqrt(rigidity / (steel.density * height)) / (2 * math.pi * side**2)
    # Leissa, Journal of Sound and Vibration 31, 1973: a square plate with one side clamped, Poisson's ratio .3.
    assert (modes.frequency / unit).tolist() == pytest.approx([3.4917, 8.5246, 21.429, 27.331, 31.111], rel=0.03)


@pytest.mark.parametrize(("ratio", "error"), [(1e-3, 1e-4), (0.3, 3e-3), (1e3, 0.03)])
def test_the_basis_of_free_and_attachment_modes_has_the_held_bodys_modes(ratio: float, error: float):
    solid = block((0.2, 0.03, 0.004), (16, 3, 1))
    held = HeldModes(solid, NOMINAL, count=24)
    ends = tuple(patch for patch in held.patches if patch.is_end and abs(patch.place[0]) > 0.99)
    support = Support(ends, ratio * held.stiffness_scale)
    found, true = held.on(support), elastic_modes(solid, NOMINAL, count=24, support=support)
    assert found.frequency[:16].tolist() == pytest.approx(true.frequency[:16].tolist(), rel=error)
    overlap = torch.einsum("nmd,nmd->m", found.shapes[:, :8], true.shapes[:, :8]).abs()
    norms = found.shapes[:, :8].square().sum((0, 2)) * true.shapes[:, :8].square().sum((0, 2))
    assert float((overlap / norms.sqrt()).min()) > 0.99


def test_a_lying_plate_may_be_held_along_each_of_its_sides():
    mesh = SecondOrder.of(block((0.24, 0.16, 0.003), (12, 8, 1)))
    sides = [mesh.nodes[patch.nodes(mesh)] for patch in patches_of(mesh)]
    # Not at its face, which is half of it.
    assert sorted(round(float(np.ptp(side[:, :2], axis=0).max()), 6) for side in sides) == [0.16, 0.16, 0.24, 0.24]
    assert all(np.ptp(side[:, :2], axis=0).min() < 0.01 for side in sides)


def test_a_cone_on_its_tip_may_be_held_at_its_tip():
    flat = block((1.0, 1.0, 1.0), (4, 4, 4))
    points = flat.points.clone()
    points[:, :2] = (points[:, :2] - 0.5) * (0.05 + points[:, 2:])
    mesh = SecondOrder.of(Solid.build(points, flat.cells))
    tip = next(patch for patch in patches_of(mesh) if patch.name == "its lowest part")
    assert float(np.ptp(mesh.nodes[tip.nodes(mesh)], axis=0).max()) < 0.1


@pytest.mark.parametrize("held", ["point", "line"])
def test_a_body_that_turns_about_its_support_has_no_mode_at_zero(held: str):
    solid = block((0.1, 0.02, 0.01), (6, 2, 1))
    # Upright on an edge or on a corner.
    turn = {"line": (0.0, -1.0, -1.0), "point": (-1.0, -1.1, -1.2)}[held]
    patch = Patch(held, tuple(float(each) for each in np.array(turn) / np.linalg.norm(turn)))
    modes = elastic_modes(solid, NOMINAL, count=4, support=Support((patch,), RIGID))
    assert bool(torch.isfinite(modes.frequency).all())
    assert float(modes.frequency[0]) > 10.0


def test_a_body_of_large_faces_alone_has_no_support():
    with raises(SimulationError, name="patches"):
        HeldModes(block((1.0, 1.0, 1.0), (1, 1, 1)), NOMINAL, count=2)


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


def ring(radius: float, wall: float) -> float:
    """Inextensional bending in two waves, Hz (Love, Mathematical Theory of Elasticity, art. 293, in plane strain)."""
    speed = math.sqrt(STEEL.young / (12 * STEEL.density * (1 - STEEL.poisson**2)))
    return 6 / math.sqrt(5) * wall / radius**2 * speed / (2 * math.pi)


def test_a_thin_tube_bends_like_a_ring():
    radius, wall = 0.05, 0.002
    solid = filled_solid(checked(tube(radius, wall, 0.15), log=silent), 15_000)
    assert float(elastic_modes(solid, STEEL, count=1).frequency[0]) == pytest.approx(ring(radius, wall), rel=0.04)


def test_facets_may_cut_across_a_wall_whose_thickness_is_known():
    radius, wall = 0.05, 0.001
    mesh = weld(tube(radius, wall, 0.15, sides=96, rings=16))
    unknown, known = wall_of(mesh), wall_of(mesh, wall)
    with pytest.raises(SimulationError):
        unknown.solids(unknown.length(9_000))
    solid = known.solids(known.length(9_000))(known.thickness)
    assert float(elastic_modes(solid, STEEL, count=1).frequency[0]) == pytest.approx(ring(radius, wall), rel=0.04)


def test_prisms_fill_a_wall_of_uneven_thickness():
    shape = make_shape("tray", seed=14)
    mesh = weld(shape.surface)
    wall = wall_of(mesh)
    assert wall.thickness == pytest.approx(shape.thickness, rel=0.1)
    solid = wall.solids(wall.length(12_000))(wall.thickness)
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
            wall.solids(wall.length(12_000))


def test_a_plate_of_twelve_triangles_has_leissas_frequencies():
    side, thickness = 0.2, 0.002
    body = CandidateBodies(box(side, side, thickness), thicknesses=[None], count=3, dofs=8_000).bodies[0]
    rigidity = NOMINAL.young * thickness**3 / (12 * (1 - NOMINAL.poisson**2))
    found = 2 * math.pi * body.elastic.frequency * side**2 * math.sqrt(NOMINAL.density * thickness / rigidity)
    assert found.tolist() == pytest.approx([13.489, 19.789, 24.432], rel=0.01)


class Converging(CandidateBodies):
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
    solids = (filled_solid(checked(shape.surface, log=silent), 20_000), shape.solid)
    found, expected = (float(elastic_modes(solid, STEEL, count=1).frequency[0]) for solid in solids)
    assert found == pytest.approx(expected, rel=0.08)
