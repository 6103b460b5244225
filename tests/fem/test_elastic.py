"""Finite elements against beams, plates, a second implementation, and the laws that every elastic body obeys."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.sparse.linalg
import torch

from avmsf.errors import SimulationError
from avmsf.fem.eigen import lowest_vibrations, rigid_motions
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.elements import SecondOrder, mass, stiffness
from avmsf.fem.isotropic import IsotropicModes, isotropic_modes
from avmsf.fem.material import GLASS, STEEL, WOOD, Material
from avmsf.fem.solid import Solid
from avmsf.fem.walls import shell
from factories.looked_at import sphere
from factories.raising import raises
from oracles.block import block

BRACKET = ((0.07, 0.05, 0.011), (3, 2, 1))
"""A block with three different sides, so that no two modes share a frequency."""


@pytest.fixture(scope="module")
def bracket() -> Solid:
    return block(*BRACKET)


@pytest.fixture(scope="module")
def modes(bracket: Solid) -> ElasticModes:
    return elastic_modes(bracket, STEEL, count=8)


def matrices(solid: Solid, material: Material) -> tuple[SecondOrder, scipy.sparse.csr_array, scipy.sparse.csr_array]:
    mesh = SecondOrder.of(solid)
    density = torch.full((len(solid.cells),), material.density, dtype=torch.float64)
    return mesh, stiffness(mesh, material).tocsr(), mass(mesh, density)


def test_a_slender_bar_bends_as_a_free_beam():
    length, height, width = 0.4, 0.008, 0.012
    found = elastic_modes(block((length, height, width), (16, 1, 1)), STEEL, count=6).frequency
    speed = math.sqrt(STEEL.young / STEEL.density)
    # cosh x cos x = 1 at the free ends, for bending in the plane of either side.
    waves = np.array([4.730040745, 7.853204624, 10.995607838])
    expected = np.concatenate(
        [waves**2 / (2 * math.pi * length**2) * speed * side / math.sqrt(12) for side in (height, width)]
    )
    # Euler and Bernoulli leave out shear and rotary inertia, at most 1.7 % here (x^2 (side / length)^2 / 2).
    for frequency in np.sort(expected)[:5]:
        assert float((found / frequency - 1).abs().min()) < 0.02
    assert float(found[0]) == pytest.approx(expected.min(), rel=5e-3)


def test_a_bar_rings_along_itself_and_twists():
    # Poisson's ratio of nearly zero: the bar keeps its section, and f = c / 2 L and its multiples are exact.
    cork = Material("cork", 200.0, 2e7, 1e-6, 0.0, 0.0)
    found = elastic_modes(block((0.3, 0.03, 0.03), (10, 2, 2)), cork, count=12)
    speed = math.sqrt(cork.young / cork.density)
    twist = speed / math.sqrt(2.0) * math.sqrt(0.1406 / (1.0 / 6.0))  # torsion constant of a square, .1406 a^4
    # Both hold in the limit of a thin bar; that a section's corners lag a little costs the twist most.
    for expected, tolerance in ((speed / 0.6, 1e-3), (twist / 0.6, 0.02)):
        assert float((found.frequency / expected - 1).abs().min()) < tolerance


def test_frequencies_converge_as_second_order_elements_do():
    two, four, six = (
        elastic_modes(block((0.05, 0.04, 0.03), (n, n, n)), GLASS, count=3).frequency.numpy() for n in (2, 4, 6)
    )
    for coarse, middle, fine in zip(two, four, six, strict=True):
        # Errors of n^-p make this ratio of differences, Richardson's. Smooth bodies have p = 4, edges cost some of it;
        # linear elements have 2.
        ratio = (coarse - middle) / (middle - fine)
        order = scipy.optimize.brentq(lambda p, r=ratio: r * (4.0**-p - 6.0**-p) - (2.0**-p - 4.0**-p), 0.5, 8.0)
        assert 2.8 < order < 4.2
        assert coarse > middle > fine


def test_the_few_lowest_modes_of_a_thin_ball_are_found_though_they_are_close_together():
    radius, thickness = 0.05, 0.001
    found = elastic_modes(shell(sphere(radius), thickness=thickness, detail=0.08), GLASS, count=5).frequency
    # Lamb's membrane: its five modes of degree 2; facets and bending make them 5 % higher.
    linear, constant = 7.0 + 3.0 * GLASS.poisson, 4.0 * (1.0 - GLASS.poisson**2)
    square = 0.5 * (linear - math.sqrt(linear**2 - 4.0 * constant)) * GLASS.young / GLASS.density
    expected = math.sqrt(square) / (2 * math.pi * (radius - 0.5 * thickness))
    assert found.tolist() == pytest.approx([expected] * 5, rel=0.07)


def test_matrices_are_those_of_another_implementation(bracket):
    skfem = pytest.importorskip("skfem", reason="the oracle is scikit-fem")
    from skfem.helpers import dot
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh, forces, weights = matrices(bracket, GLASS)
    other = skfem.MeshTet(bracket.points.numpy().T, bracket.cells.numpy().T)
    basis = skfem.Basis(other, skfem.ElementVector(skfem.ElementTetP2()))
    expected = linear_elasticity(*lame_parameters(GLASS.young, GLASS.poisson)).assemble(basis).toarray()
    inertia = skfem.BilinearForm(lambda u, v, w: GLASS.density * dot(u, v)).assemble(basis).toarray()
    # Each of its degrees of freedom has a place and a component; ours are found by their place.
    rows = np.empty(basis.N, dtype=int)
    for freedom in range(basis.N):
        node = np.linalg.norm(mesh.nodes - basis.doflocs[:, freedom], axis=1).argmin()
        rows[freedom] = 3 * node + {"u^1": 0, "u^2": 1, "u^3": 2}[name_of(basis, freedom)]
    assert len(set(rows)) == 3 * len(mesh.nodes)
    np.testing.assert_allclose(forces.toarray()[np.ix_(rows, rows)], expected, atol=1e-9 * expected.max())
    ours = np.kron(weights.toarray(), np.eye(3))[np.ix_(rows, rows)]
    np.testing.assert_allclose(ours, inertia, atol=1e-9 * inertia.max())


def name_of(basis: object, freedom: int) -> str:
    found = [
        name
        for table, names in ((basis.nodal_dofs, basis.elem.dofnames[:3]), (basis.edge_dofs, basis.elem.dofnames[3:]))
        for name, row in zip(names, table, strict=True)
        if freedom in row
    ]
    return found[0]


def test_modes_are_those_of_the_whole_spectrum(bracket, modes):
    _, forces, weights = matrices(bracket, STEEL)
    values = np.sort(scipy.linalg.eigvalsh(forces.toarray(), np.kron(weights.toarray(), np.eye(3))))
    # But for the motions of a rigid body.
    assert abs(values[5]) < 1e-8 * values[6]
    expected = np.sqrt(values[6:14]) / (2 * math.pi)
    np.testing.assert_allclose(modes.frequency.numpy(), expected, rtol=1e-9)


def test_motions_and_shapes_are_mass_normalized_and_free_of_each_other(bracket):
    mesh, forces, weights = matrices(bracket, STEEL)
    rigid = rigid_motions(mesh.nodes, weights)
    assert np.abs(forces @ rigid).max() < 1e-9 * abs(forces).max() * np.abs(rigid).max()
    assert weights.sum() == pytest.approx(7850.0 * 0.07 * 0.05 * 0.011, rel=1e-12)
    squares, shapes = lowest_vibrations(forces, weights, rigid, count=10, shift=1e4, supported=False)
    heavy = scipy.sparse.kron(weights, np.eye(3))
    np.testing.assert_allclose(rigid.T @ heavy @ rigid, np.eye(6), atol=1e-10)
    np.testing.assert_allclose(shapes.T @ heavy @ shapes, np.eye(10), atol=1e-9)
    np.testing.assert_allclose(shapes.T @ heavy @ rigid, 0.0, atol=1e-9)
    stored = shapes.T @ forces @ shapes
    np.testing.assert_allclose(stored, np.diag(squares), atol=1e-8 * squares[-1])


def test_size_stiffness_and_density_obey_the_scaling_laws(bracket, modes):
    larger = elastic_modes(Solid.build(2.5 * bracket.points, bracket.cells), STEEL, count=8)
    assert torch.allclose(larger.frequency, modes.frequency / 2.5, rtol=1e-9)
    assert torch.allclose(larger.shapes.abs(), modes.shapes.abs() * 2.5**-1.5, atol=1e-6)
    factor = torch.full((len(bracket.cells),), 4.0)
    stiffer = elastic_modes(bracket, STEEL, count=8, stiffness_factor=factor)
    assert torch.allclose(stiffer.frequency, 2.0 * modes.frequency, rtol=1e-9)
    heavier = elastic_modes(bracket, STEEL, count=8, density_factor=factor)
    assert torch.allclose(heavier.frequency, modes.frequency / 2.0, rtol=1e-9)
    assert heavier.mass == pytest.approx(4.0 * modes.mass, rel=1e-12)
    assert modes.mass == pytest.approx(STEEL.density * bracket.volume, rel=1e-12)


def test_soft_springs_raise_each_mode_by_its_motion_there(bracket, modes):
    places = torch.tensor([[0.01, 0.012, 0.0], [0.06, 0.01, 0.0], [0.035, 0.045, 0.0]], dtype=torch.float64)
    stiff = 1e4
    held = elastic_modes(bracket, STEEL, count=8, springs=(places, stiff))
    assert len(held) == 8
    raised = (2 * math.pi) ** 2 * (held.frequency**2 - modes.frequency**2)
    # Rayleigh: a spring's energy in a mode that moves its foot by one unit.
    expected = stiff * modes.at(places).square().sum(dim=(0, 2))
    assert torch.allclose(raised, expected, rtol=1e-2)


def test_interpolation_is_exact_for_second_degree_and_takes_the_nearest_place(modes):
    nodes = modes.nodes
    bent = torch.stack([nodes[:, 0] * nodes[:, 1], nodes[:, 2] ** 2, nodes[:, 0] + 1.0], dim=1)
    field = ElasticModes(modes.frequency[:1], nodes, modes.triangles, bent[:, None], STEEL, modes.mass)
    drawn = torch.rand(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    size = torch.tensor(BRACKET[0], dtype=torch.float64)
    top = drawn * size
    top[:, 2] = size[2]
    expected = torch.stack([top[:, 0] * top[:, 1], top[:, 2] ** 2, top[:, 0] + 1.0], dim=1)
    assert torch.allclose(field.at(top)[:, 0], expected, atol=1e-14)
    # Above the block the nearest place is straight below.
    above = top + torch.tensor([0.0, 0.0, 0.02])
    assert torch.allclose(field.at(above)[:, 0], expected, atol=1e-14)
    along = torch.nn.functional.normalize(drawn - 0.5, dim=1)
    assert torch.allclose(field.gains(above, along)[:, 0], (expected * along).sum(dim=1), atol=1e-14)


def test_as_many_modes_as_there_cannot_be_or_parts_are_refused(bracket):
    for count, name, value in ((0, "count", 0), (310, "nodes", 105)):
        with raises(SimulationError, name=name, value=value):
            elastic_modes(bracket, STEEL, count=count)
    apart = torch.cat([bracket.points, bracket.points + 1.0])
    parts = Solid.build(apart, torch.cat([bracket.cells, bracket.cells + len(bracket.points)]))
    with raises(SimulationError, name="parts", value=2):
        elastic_modes(parts, STEEL, count=4)
    with pytest.raises(SimulationError):
        isotropic_modes(parts, count=3)


@cache
def solid() -> Solid:
    return block((0.12, 0.07, 0.02), (5, 3, 1))


@cache
def body() -> IsotropicModes:
    return isotropic_modes(solid(), count=8)


@pytest.mark.parametrize("poisson", [0.02, 0.19, 0.29, 0.45])
def test_isotropic_modes_are_those_of_direct_solves(poisson: float):
    material = replace(WOOD, poisson=poisson)
    found, known = body().modes(material), elastic_modes(solid(), material, count=8)
    torch.testing.assert_close(found.frequency, known.frequency, rtol=3e-4, atol=0.0)
    both = (found.shapes * known.shapes).sum(dim=(0, 2))
    alike = both.abs() / (found.shapes.square().sum(dim=(0, 2)) * known.shapes.square().sum(dim=(0, 2))).sqrt()
    assert float(alike.min()) > 0.999
    size = found.shapes.square().sum(dim=(0, 2)) / known.shapes.square().sum(dim=(0, 2))
    torch.testing.assert_close(size, torch.ones_like(size), rtol=2e-3, atol=0.0)
    assert found.mass == pytest.approx(known.mass, rel=1e-12)


def test_the_gradient_by_poissons_ratio_is_that_of_differences():
    ratio = torch.tensor(0.27, dtype=torch.float64, requires_grad=True)
    weights = torch.arange(1.0, 9.0, dtype=torch.float64)
    (weights @ body().squares(ratio)).backward()
    with torch.no_grad():
        above, below = (weights @ body().squares(ratio + step) for step in (1e-5, -1e-5))
    assert ratio.grad is not None
    torch.testing.assert_close(ratio.grad, (above - below) / 2e-5, rtol=1e-5, atol=0.0)
