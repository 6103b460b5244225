"""Kernel families: what makes them covariances, what they are invariant to, and splines as an independent oracle."""

from dataclasses import replace
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import torch
from scipy.interpolate import RBFInterpolator

from avmsf.field.gains import kernels
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import KernelFamily, Sites, Smooth, ThinPlate
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture
from avmsf.field.gains.mixture_gains import MixtureGains
from factories.gain_cases import POSITIONAL, SIZE, draw, impacts, plate
from oracles import gain_model as oracle

KINDS = [*POSITIONAL, Elastic]
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def made(kind: type[KernelFamily], sites: Sites) -> KernelFamily:
    return Elastic(sites, SIZE, plate()) if kind is Elastic else kind(sites, SIZE)


def scattered(dimensions: int, count: int, *, seed: int = 5) -> torch.Tensor:
    """Return points that differ along the first axes of an oblique frame alone."""
    points = draw(count, 3, seed=seed) * torch.tensor([0.3, 0.2, 0.15], dtype=torch.float64)
    points[:, dimensions:] = 0.07
    return points @ turn().T + torch.tensor([0.5, -2.0, 0.1], dtype=torch.float64)


def turn() -> torch.Tensor:
    """Return a rotation about all axes."""
    half = torch.tensor([[0.0, -0.3, 0.7], [0.3, 0, -1.1], [-0.7, 1.1, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(half)


def alike(points: torch.Tensor) -> Sites:
    """Return impacts that all go along one direction."""
    return Sites(points, UP.expand(len(points), 3))


def test_the_family_of_the_page_takes_part_in_fits_and_files(monkeypatch):
    page = (Path(__file__).parents[3] / "docs" / "gain-models.md").read_text()
    section = page.split("### A new family\n")[1].split("\n### ")[0]
    code = "\n".join(line for line in section.splitlines() if line.startswith("    "))
    made: dict[str, type[KernelFamily]] = {}
    exec(dedent(code), {"torch": torch, "KernelFamily": KernelFamily}, made)
    monkeypatch.setitem(kernels.POSITIONAL, "periodic", made["Periodic"])
    sites = alike(draw(12, 3, seed=1))
    around = torch.atan2(*(sites.points - sites.points.mean(0))[:, [1, 0]].T)
    values = torch.stack([around.cos(), (around + 1.0).sin()], dim=1).to(torch.complex128)
    families = [kind(sites, 1.0) for kind in kernels.POSITIONAL.values()]
    ones = torch.ones(2, dtype=torch.float64)
    given = fit_mixture(
        families, MeasuredGains(values, 1e-6 * ones, 500.0 * (ones + ones.cumsum(0)), ones), sites.points.float(),
        directional=False,
    )  # fmt: skip
    share = dict(zip((each.kind for each in given.families), given.shares().mean(1).tolist(), strict=True))
    assert share["periodic"] > 0.9
    back = MixtureGains.restore(given.record(), given.tensors())
    asked = draw(5, 3, seed=2)
    assert torch.equal(back.predict(asked).mean, given.predict(asked).mean)


def test_elastic_kernels_are_loadings_times_factors():
    family, known, others = Elastic(impacts(6, seed=1), SIZE, plate()), impacts(4, seed=3), impacts(9, seed=2)
    rows = torch.arange(len(family)).flip(0)
    found = family.factors(others, known) @ family.loadings(known, rows).mT
    assert torch.allclose(found, family.take(rows).between(others, known), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [4, 12])
def test_kernels_are_covariances_everywhere(kind, count):
    """Symmetric and positive semidefinite among the reference impacts and any others together."""
    family, others = made(kind, impacts(count, seed=1)), impacts(9, seed=2)
    both = Sites(
        torch.cat([family.reference.points, others.points]), torch.cat([family.reference.directions, others.directions])
    )
    joint = family.between(both, both)
    assert torch.allclose(joint, joint.mT, rtol=1e-12, atol=1e-12)
    assert bool((torch.linalg.eigvalsh(joint).amin(1) > -1e-12 * joint.abs().amax((1, 2)) - 1e-300).all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [4, 12])
def test_kernels_have_mean_one_on_the_diagonal(kind, count):
    diagonal = torch.diagonal(made(kind, impacts(count, seed=1)).kernels(), dim1=1, dim2=2).mean(1)
    assert torch.allclose(diagonal, torch.ones_like(diagonal), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_kernels_to_other_places_agree_with_those_among_the_contacts(kind):
    family = made(kind, impacts(12, seed=1))
    again = Sites(family.reference.points.clone(), family.reference.directions.clone())
    assert torch.allclose(family.between(again, again), family.kernels(), rtol=1e-12, atol=1e-12)
    rows = torch.tensor([7, 0, 3])
    cross = family.between(again.take(rows), family.reference)
    assert torch.allclose(cross, family.kernels()[:, rows], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_own_variance_is_the_diagonal(kind):
    family, others = made(kind, impacts(12, seed=1)), impacts(9, seed=2)
    diagonal = torch.diagonal(family.between(others, others), dim1=1, dim2=2)
    assert torch.allclose(family.own(others), diagonal, rtol=1e-9, atol=1e-12)
    assert torch.allclose(family.take(torch.tensor([-1])).own(others), diagonal[-1:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_mean_is_the_kernels_times_their_coefficients(kind):
    family, others = made(kind, impacts(12, seed=1)), impacts(9, seed=2)
    kept = family.take(torch.arange(0, len(family), 2))
    solved = draw(len(kept), 12, 3, seed=4)
    expected = torch.einsum("hpc,hcs->ps", kept.between(others, family.reference), solved)
    found = kept.mean(others, family.reference, kept.coefficients(solved))
    assert torch.allclose(found, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_an_opposite_impact_changes_the_sign(kind):
    family, others = made(kind, impacts(12, seed=1)), impacts(9, seed=2)
    cross = family.between(others, family.reference)
    opposite = family.between(replace(others, directions=-others.directions), family.reference)
    assert torch.equal(opposite, -cross)
    assert bool(cross[-1].any())


@pytest.mark.parametrize("kind", POSITIONAL)
def test_perpendicular_impacts_say_nothing_of_each_other(kind):
    family = made(kind, alike(impacts(12, seed=1).points))
    across = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    others = Sites(family.reference.points, across.expand(12, 3))
    assert not family.between(others, family.reference).any()
    assert torch.equal(family.own(others), family.own(family.reference))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [4, 12])
def test_moving_the_object_changes_nothing(kind, count):
    sites, others, shift = impacts(count, seed=1), impacts(9, seed=2), torch.tensor([3.0, -1.0, 2.0]).double()
    moved, elsewhere = (Sites(each.points @ turn().T + shift, each.directions @ turn().T) for each in (sites, others))
    one = made(kind, sites)
    if kind is Elastic:
        body = replace(plate(), nodes=plate().nodes @ turn().T + shift, shapes=plate().shapes @ turn().T)
        other: KernelFamily = Elastic(moved, SIZE, body)
    else:
        other = kind(moved, SIZE)
    found = other.between(elsewhere, moved)
    # The elastic family keeps shapes in single precision.
    assert torch.allclose(found, one.between(others, sites), rtol=0, atol=1e-5 if kind is Elastic else 1e-9)


@pytest.mark.parametrize("kind", POSITIONAL)
@pytest.mark.parametrize("count", [4, 12])
def test_a_larger_object_has_the_same_kernels(kind, count):
    sites, others = impacts(count, seed=1), impacts(9, seed=2)
    larger, elsewhere = (replace(each, points=7.0 * each.points) for each in (sites, others))
    one, other = kind(sites, SIZE), kind(larger, 7.0 * SIZE)
    found = other.between(elsewhere, larger)
    assert torch.allclose(found, one.between(others, sites), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", POSITIONAL)
@pytest.mark.parametrize("dimensions", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 9])
def test_contacts_may_lie_at_a_point_on_a_line_or_in_a_plane(kind, dimensions, count):
    family, others = kind(alike(scattered(dimensions, count)), 0.4), alike(scattered(3, 6, seed=8))
    for each in (family.reference, others):
        among = family.between(each, each)
        assert bool(torch.isfinite(among).all())
        assert float(torch.linalg.eigvalsh(among).min()) > -1e-9 * float(among.abs().max())


def test_smooth_kernels_are_the_written_ones():
    points = scattered(2, 10)
    family, middle = Smooth(alike(points), 0.4), points.mean(0)
    squares = (points[:, None] - points).square().sum(2)
    # Standardized along orthogonal axes, the affine kernel's inner product is that of the pseudoinverse covariance.
    inverse = torch.linalg.pinv((points - middle).T @ (points - middle) / 10, rtol=1e-9, hermitian=True)
    affine = (1.0 + (points - middle) @ inverse @ (points - middle).T) / 3.0
    smooth = [torch.exp(-0.5 * squares / (share * 0.4) ** 2) for share in (0.05, 0.1, 0.2, 0.4, 0.8)]
    mixed = [(1.0 - share) * each + share * affine for share in (0.5, 0.9) for each in smooth[1:]]
    assert torch.allclose(family.kernels(), torch.stack(smooth + mixed), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_thin_plate_kernels_are_the_written_ones(dimensions):
    """Along the axes of the contacts, over the longest extent, with each share of the affine part."""
    known, others = scattered(dimensions, 12), scattered(dimensions, 5, seed=6)
    middle, both = known.mean(0), torch.cat([known, others])
    axes = torch.linalg.svd(known - middle, full_matrices=False).Vh[:dimensions].T
    along = ((both - middle) @ axes).numpy()
    along /= np.ptp(along[:12], axis=0).max()
    expected = [oracle.thin_plate(along, along[:12], share) for share in (0.3, 0.7, 0.95)]
    found = ThinPlate(alike(known), 0.4).between(alike(both), alike(both)).numpy()
    assert found == pytest.approx(np.stack(expected), rel=1e-8, abs=1e-9)


def spline_case(dimensions: int, count: int) -> tuple[ThinPlate, Sites, torch.Tensor]:
    points = scattered(dimensions, count)
    return ThinPlate(alike(points), 0.4), alike(scattered(dimensions, 8, seed=6)), draw(count, 2, seed=7)


def mean_of(family: ThinPlate, row: int, share: int, sites: Sites, values: torch.Tensor) -> torch.Tensor:
    """Return the Gaussian process's mean with one kernel and one noise share."""
    weights = torch.zeros(1, len(NOISE_SHARES), values.shape[1], dtype=torch.float64)
    weights[:, share] = 1.0
    kept = family.take(torch.tensor([row]))
    floor = torch.zeros(values.shape[1], dtype=torch.float64)
    process = KernelMixture(kept.kernels(), values, floor, weights)
    return kept.mean(sites, family.reference, kept.coefficients(process.solve()))


@pytest.mark.parametrize(("dimensions", "count"), [(1, 9), (2, 14), (3, 16), (1, 3), (2, 5), (3, 7)])
@pytest.mark.parametrize("share", range(len(NOISE_SHARES)))
def test_the_thin_plate_mean_is_scipys_spline(dimensions, count, share):
    """But for the affine part, which shrinks by its share b of the variance to b / (b + noise)."""
    family, sites, values = spline_case(dimensions, count)
    bending = count >= 2 * (dimensions + 1)
    points = family.reference.points.numpy()
    _, _, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    known, asked = ((each.points.numpy() - points.mean(0)) @ axes[:dimensions].T for each in (family.reference, sites))
    drift, drift_asked = (
        np.column_stack([np.ones(len(each)), each]) if bending else np.ones((len(each), 1)) for each in (known, asked)
    )
    affine = drift_asked @ np.linalg.lstsq(drift, values.numpy(), rcond=None)[0]
    longest = np.ptp(known, axis=0).max()
    for row, (bent, constant) in enumerate(family.shares.tolist()):
        noise = NOISE_SHARES[share]
        # Distances are over the longest extent; r^2 log r in another unit differs by a factor, and by what has no part.
        smoothing = noise / bent * (longest**2 if bending else longest)
        kernel, degree = ("thin_plate_spline", 1) if bending else ("linear", 0)
        spline = RBFInterpolator(known, values.numpy(), kernel=kernel, degree=degree, smoothing=smoothing)(asked)
        expected = spline - noise / (constant + noise) * affine
        found = mean_of(family, row, share, sites, values).numpy()
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-8)


def test_a_plate_bends_if_its_places_are_many_not_its_contacts():
    three = scattered(2, 3)
    family = ThinPlate(alike(three.repeat(4, 1)), 0.4)
    once = ThinPlate(alike(three), 0.4)
    places = alike(scattered(2, 8, seed=6))
    found, expected = (each.between(places, places) for each in (family, once))
    assert torch.allclose(found, expected, rtol=1e-9, atol=1e-12)
