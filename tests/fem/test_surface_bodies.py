"""The bodies that a surface may hide, and the thickness of their wall by the evidence of gains."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SimulationError
from avmsf.fem import body_meshes, candidate_bodies
from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import DISCREPANCY, MATERIALS, NOMINAL, factor_range
from avmsf.fem.thickness import search_thickness
from avmsf.mesh.surface import Surface
from factories.looked_at import sphere, surface_of
from factories.made_dome import bodies
from factories.made_sheet import sheet_over
from factories.raising import raises
from oracles.block import block


def sheet() -> Surface:
    """Return a flat rectangle whose normals point up."""
    return sheet_over(np.linspace(0, 0.24, 13), np.linspace(0, 0.17, 10))


def computed(surface: Surface, **settings: object) -> CandidateBodies:
    """Return the bodies of a surface, which are there now."""
    bodies = CandidateBodies(surface, **settings)  # type: ignore[arg-type]
    assert bodies.bodies
    return bodies


def test_a_sheet_with_a_wall_vibrates_as_the_plate_it_is():
    bodies = computed(sheet(), thicknesses=[0.004], count=12, dofs=6000).bodies
    assert [body.name for body in bodies] == ["wall of 4 mm"]
    assert bodies[0].fine
    found, plate = bodies[0].elastic, elastic_modes(block((0.24, 0.17, 0.004), (12, 9, 1)), NOMINAL, count=12)
    assert float((found.frequency / plate.frequency - 1).abs().max()) < 0.02
    places = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.24, 0.17, 0.0])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(200, 3)
    own, other = found.gains(places, up), plate.gains(places, up)
    alike = (own * other).sum(0) ** 2 / ((own**2).sum(0) * (other**2).sum(0))
    assert float(alike[:6].min()) > 0.99


def test_walls_of_a_sheet_are_tried_coarsely_and_the_chosen_one_made_fine(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(candidate_bodies, "COARSE_DOFS", 1500)
    found = computed(sheet(), count=6, dofs=4000)
    assert [body.thickness for body in found.bodies] == pytest.approx(
        [part * math.hypot(0.24, 0.17) for part in candidate_bodies.THICKNESS_RATIOS]
    )
    assert not any(body.fine for body in found.bodies)
    body = found.bodies[1]
    fine = CandidateBodies(sheet(), count=6, dofs=4000).refined(body)
    assert fine.fine
    assert fine.thickness == body.thickness
    assert CandidateBodies(sheet()).refined(fine) is fine
    assert len(fine.elastic.nodes) > 2 * len(body.elastic.nodes)
    # Triangles of the coarse one are a sixth of the sheet long: against a regular mesh it is 3 and 6 % too high.
    assert float((fine.elastic.frequency / body.elastic.frequency - 1).abs()[:2].max()) < 0.07


@pytest.mark.slow
def test_what_a_ball_encloses_vibrates_as_lambs_sphere_does_and_is_kept(tmp_path: Path):
    inwards = Surface(sphere().vertices, sphere().faces.flip(1))
    found = computed(inwards, thicknesses=[None], count=20, dofs=10000, cache=tmp_path).bodies[0]
    # Lamb: the torsional oscillation of degree 2, whose wave number times radius is 2.501, belongs to five modes.
    shear = math.sqrt(NOMINAL.young / (2 * (1 + NOMINAL.poisson)) / NOMINAL.density)
    # Fillings by other seeds differ by 2 % in frequency at this size.
    assert found.elastic.frequency[:5].numpy() == pytest.approx(2.501 * shear / (2 * math.pi * 0.05), rel=0.04)
    kept = sorted(tmp_path.iterdir())
    again = computed(inwards, thicknesses=[None], count=20, dofs=10000, cache=tmp_path).bodies[0]
    assert torch.equal(again.elastic.shapes, found.elastic.shapes)
    for name in ("stiffness", "mass", "poisson"):
        assert (getattr(again.elastic.perturbations, name) == getattr(found.elastic.perturbations, name)).all()
    assert sorted(tmp_path.iterdir()) == kept
    moved = Surface(inwards.vertices + 0.001, inwards.faces)
    computed(moved, thicknesses=[None], count=20, dofs=10000, cache=tmp_path)
    assert len(sorted(tmp_path.iterdir())) == 2


@pytest.mark.slow
def test_both_sides_of_a_wall_are_filled_and_given_no_wall():
    outer, inner = trimesh.creation.icosphere(3, radius=0.06), trimesh.creation.icosphere(3, radius=0.054)
    inner.invert()
    found = computed(surface_of(trimesh.util.concatenate([outer, inner])), count=8, dofs=8000)
    assert [body.thickness for body in found.bodies] == [None]
    # A hollow ball, not a massive one.
    mass = NOMINAL.density * 4 / 3 * math.pi * (0.06**3 - 0.054**3)
    assert found.bodies[0].elastic.mass == pytest.approx(mass, rel=0.06)


def test_boxes_that_overlap_are_one_body():
    one, other = trimesh.creation.box((0.3, 0.05, 0.02)), trimesh.creation.box((0.05, 0.2, 0.015))
    messages: list[str] = []
    both = surface_of(trimesh.util.concatenate([one, other]))
    found = computed(both, thicknesses=[None, 0.001, 0.5], count=6, dofs=6000, log=messages.append)
    assert [body.name for body in found.bodies] == ["solid body"]
    volume = 0.3 * 0.05 * 0.02 + (0.2 - 0.05) * 0.05 * 0.015
    assert found.bodies[0].elastic.mass == pytest.approx(NOMINAL.density * volume, rel=0.05)
    (thick,) = (each for each in messages if each.startswith("not a candidate body: wall of 500 mm"))
    assert re.fullmatch(".*: wall of 500 mm: expected a thickness below the object's width of .* mm, got 500 mm", thick)


@pytest.mark.slow
def test_the_aircraft_is_filled(shared: Path):
    surface = Surface.read(shared / "aircraft_response/surface.obj")
    found = computed(surface, count=6, dofs=12_000)
    assert [body.name for body in found.bodies] == ["solid body"]
    # Its wings bend first, far below all else: as metal plates of 8 mm over 1.5 m do.
    assert 10 < float(found.bodies[0].elastic.frequency[0]) < 20


APART = [trimesh.creation.box(bounds=[(x, 0.0, 0.0), (x + 0.1, 0.1, 0.1)]) for x in (0.0, 0.3)]


@pytest.mark.parametrize(
    ("make", "thicknesses", "refused"),
    [
        (lambda: surface_of(trimesh.util.concatenate(APART)), [None, 0.001], ["solid body", "wall of 1 mm"]),
        (sheet, [0.2], ["wall of 200 mm"]),
        (sphere, [0.04], ["wall of 40 mm"]),
    ],
)
def test_surfaces_of_no_body_are_refused_with_all_reasons(make, thicknesses, refused):
    with raises(SimulationError, name="surface") as caught:
        computed(make(), thicknesses=thicknesses, count=6, dofs=3000)
    assert [reason.partition(": ")[0] for reason in caught.value.value] == refused


def test_a_mesh_too_large_for_the_memory_is_refused_with_the_size_that_fits(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(body_meshes, "free_memory", lambda: 2 * 377e6)
    with raises(SimulationError, name="memory") as caught:
        computed(sheet(), thicknesses=[0.004], dofs=80_000)
    [reason] = caught.value.value
    assert all(number in reason for number in ("80000", "1.6 GB", "40000"))
    monkeypatch.setattr(body_meshes, "free_memory", lambda: None)
    assert computed(sheet(), thicknesses=[0.004], count=4, dofs=2000).bodies


@pytest.fixture(scope="module")
def coarse() -> CandidateBody:
    elastic = computed(sheet(), thicknesses=[0.004], count=4, dofs=2000).bodies[0].elastic
    return CandidateBody(0.004, elastic, fine=False)


@pytest.mark.parametrize("error", [MemoryError(), SimulationError("badly shaped")])
def test_a_body_stays_coarse_where_a_finer_one_does_not_fit_into_the_memory_or_fails(monkeypatch, coarse, error):
    def fail(*solid: object, **settings: object) -> None:
        raise error

    monkeypatch.setattr(candidate_bodies, "elastic_modes", fail)
    monkeypatch.setattr(candidate_bodies, "COARSE_DOFS", 1500)
    messages: list[str] = []
    bodies = CandidateBodies(sheet(), count=4, dofs=3000, log=messages.append)
    assert bodies.refined(coarse) is coarse
    # Without a fine body nothing is said of its convergence.
    [reason] = (each for each in messages if each.startswith("wall of 4 mm: "))
    assert "using the coarse mesh" in reason


GRID = (0.001, 0.0016, 0.0025, 0.004, 0.0063)
"""Meters; None is the filled body."""


def searched(
    of: Callable[[float], float], *, filled: float = -1000.0, walls: Sequence[float | None] = GRID, made: bool = True
) -> tuple[Sequence[CandidateBody], dict[str, float] | None, list[float]]:
    """Search by the evidence of a log thickness and of the filled body; return the walls that were asked for, too."""
    asked: list[float] = []

    def walled(wall: float | None) -> CandidateBody:
        return replace(bodies()[0], thickness=wall)

    def evidence(known: Sequence[CandidateBody]) -> list[float]:
        return [filled if body.thickness is None else of(math.log(body.thickness)) for body in known]

    def make(like: CandidateBody, walls: Sequence[float]) -> list[CandidateBody | None]:
        asked.extend(walls)
        return [walled(wall) if made else None for wall in walls]

    return *search_thickness([walled(each) for each in walls], evidence, make), asked


def normal(true: float, deviation: float) -> Callable[[float], float]:
    return lambda log: -0.5 * ((log - math.log(true)) / deviation) ** 2


@pytest.mark.parametrize(
    ("true", "deviation"),
    # The last is thinner than all walls given.
    [(0.0029, 0.07), (0.0029, 0.2), (0.0018, 0.1), (0.55 * GRID[0], 0.1)],
)
def test_the_posterior_of_a_normal_evidence_is_normal_with_the_variance_of_shapes_added(true, deviation):
    found, thickness, _ = searched(normal(true, deviation), walls=(None, *GRID))
    assert thickness["median"] == pytest.approx(true, rel=0.03)
    both = math.hypot(deviation, 0.2)
    assert math.log(thickness["high"] / thickness["low"]) == pytest.approx(2 * 1.645 * both, rel=0.15)
    assert all(body.thickness is not None for body in found)
    assert min(abs(math.log(body.thickness / true)) for body in found if body.thickness) < 0.04


def test_a_maximum_between_distant_walls_is_found() -> None:
    # As of a dish from photographs: gently up to 4.2 mm, then steeply down.
    steps = np.log([0.000625, 0.0014, 0.00306, 0.0036, 0.0042, 0.005, 0.006, 0.0068, 0.015])
    table = [-81.0, -60.0, -9.0, -4.0, 0.0, -6.0, -49.0, -73.0, -240.0]
    walls = (None, 0.000625, 0.001383, 0.003061, 0.006775, 0.014997)
    found, _, _ = searched(lambda log: float(np.interp(log, steps, table)), filled=-148.0, walls=walls)
    assert found[0].thickness == pytest.approx(0.0042, rel=0.08)


def test_neither_thicker_walls_than_the_views_allow_are_tried_nor_ever_thinner_ones() -> None:
    _, thickness, asked = searched(lambda log: 20.0 * log)
    assert max(asked) < GRID[-1] == pytest.approx(thickness["median"], rel=0.1)
    _, _, asked = searched(lambda log: -20.0 * log)
    assert GRID[0] / 4 <= min(asked) < GRID[0]


def test_no_thickness_is_looked_for_where_the_filled_body_is_the_most_probable() -> None:
    found, thickness, asked = searched(lambda log: 0.0, filled=10.0, walls=(None, *GRID))
    assert (thickness, asked) == (None, [])
    assert [body.thickness for body in found] == [None]


def test_of_open_and_closed_walls_those_like_the_most_probable_one_are_searched() -> None:
    asked: list[bool] = []

    def make(like: CandidateBody, walls: Sequence[float]) -> list[CandidateBody]:
        asked.append(like.closed)
        return [replace(like, thickness=wall) for wall in walls]

    def evidence(known: Sequence[CandidateBody]) -> list[float]:
        true = {False: 0.0011, True: 0.0029}
        return [normal(true[body.closed], 0.2)(math.log(body.thickness)) - 20.0 * (not body.closed) for body in known]

    both = [replace(bodies()[0], thickness=wall, closed=closed) for closed in (False, True) for wall in GRID]
    found, thickness = search_thickness(both, evidence, make)
    assert thickness["median"] == pytest.approx(0.0029, rel=0.03)
    assert asked
    assert all(asked)
    assert all(body.closed for body in found)


def test_the_right_wall_of_every_material_is_within_the_range_of_factors() -> None:
    speeds = [math.sqrt(each.young / each.density * NOMINAL.density / NOMINAL.young) for each in MATERIALS.values()]
    low, high = factor_range()
    # A bending wall that is taken to be thinner by a part needs frequencies higher by as much.
    assert max(speeds) * (1.0 + DISCREPANCY) < high < max(speeds) * 1.3
    assert min(speeds) / (1.0 + DISCREPANCY) > low > min(speeds) / 1.3


def test_other_thicknesses_are_tried_where_a_body_cannot_be_had() -> None:
    _, thickness, asked = searched(lambda log: -((log - math.log(0.0029)) ** 2), made=False)
    assert len({round(each, 9) for each in asked}) == len(asked) > 1
    assert thickness["low"] < 0.0029 < thickness["high"]
