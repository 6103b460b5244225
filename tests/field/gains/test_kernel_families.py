"""Kernel families: what makes them covariances, what they are invariant to, and splines as an independent oracle."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import torch
from scipy.interpolate import RBFInterpolator

from avmsf._utils.tensor_files import TensorReader
from avmsf.field.config import FIELD
from avmsf.field.gains import kernels
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import KernelFamily, Sites, Smooth, ThinPlate, Visual
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.symmetry import Symmetric
from avmsf.symmetry.characters import groups_of
from avmsf.symmetry.symmetries import MirrorSymmetry, Symmetries
from factories.made_fields import SIZE, draw, impacts, plate

POSITIONAL = list(kernels.POSITIONAL.values())
KINDS = [*POSITIONAL, Elastic, Symmetric, Visual]
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
every_kind = pytest.mark.parametrize("kind", KINDS)


def made(
    kind: type[KernelFamily],
    sites: Sites,
    move: Callable[[torch.Tensor], torch.Tensor] = torch.clone,
    size: float = SIZE,
) -> KernelFamily:
    """Return a family of the plate, which a similarity moved and enlarged to this size."""
    origin, (x, y, _) = move(torch.zeros(3, dtype=torch.float64)), torch.eye(3, dtype=torch.float64)
    if kind is Elastic:
        ends = move(plate().nodes[:, None] + plate().shapes) - move(plate().nodes)[:, None]
        return Elastic(sites, size, replace(plate(), nodes=move(plate().nodes), shapes=ends))
    if kind is Visual:
        return Visual(sites, size, move(impacts(40, seed=3).points).float(), draw(40, 4, seed=4).float())
    if kind is Symmetric:
        normals = (torch.nn.functional.normalize(move(each) - origin, dim=0) for each in (x, y))
        mirrors = tuple(MirrorSymmetry(each, origin, 0.0) for each in normals)
        groups = groups_of(Symmetries((), mirrors, 0.01, 0.38, math.inf))
        return Symmetric(sites, size, groups, directional=True)
    return kind(sites, size)


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
    back = MixtureGains.restore(given.record(), TensorReader(given.tensors(), Path("page.safetensors"), FIELD))
    asked = draw(5, 3, seed=2)
    assert torch.equal(back.predict(asked).mean, given.predict(asked).mean)


@every_kind
@pytest.mark.parametrize("count", [4, 12])
def test_kernels_are_covariances_of_mean_one_at_the_contacts(kind, count):
    """Symmetric and positive semidefinite among the contacts and any other impacts, with `own` on the diagonal."""
    family, others = made(kind, impacts(count, seed=1)), impacts(9, seed=2)
    both = Sites.joined([family.reference, others])
    joint = family.between(both, both)
    torch.testing.assert_close(joint, joint.mT, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(joint[:, :count, :count], family.kernels(), rtol=1e-9, atol=1e-9)
    assert bool((torch.linalg.eigvalsh(joint).amin(1) > -1e-9 * joint.abs().amax((1, 2)) - 1e-300).all())
    diagonal = torch.diagonal(joint, dim1=1, dim2=2)
    torch.testing.assert_close(family.own(both), diagonal, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(family.take(torch.tensor([-1])).own(both), diagonal[-1:], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(diagonal[:, :count].mean(1), torch.ones(len(family)).double(), rtol=1e-9, atol=0)


@every_kind
def test_kernels_do_not_depend_on_the_memory(kind, monkeypatch):
    family, others = made(kind, impacts(12, seed=1)), impacts(9, seed=2)
    whole = family.between(others, family.reference)
    monkeypatch.setattr(kernels, "_MEMORY", 1)
    torch.testing.assert_close(family.between(others, family.reference), whole, rtol=1e-12, atol=1e-12)


@every_kind
def test_an_opposite_impact_changes_the_sign(kind):
    family, others = made(kind, impacts(12, seed=1)), impacts(9, seed=2)
    cross = family.between(others, family.reference)
    opposite = family.between(replace(others, directions=-others.directions), family.reference)
    torch.testing.assert_close(opposite, -cross, rtol=1e-12, atol=1e-12)
    assert bool(cross[-1].any())


@pytest.mark.parametrize("kind", POSITIONAL)
def test_perpendicular_impacts_say_nothing_of_each_other(kind):
    family = made(kind, alike(impacts(12, seed=1).points))
    across = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64)
    others = Sites(family.reference.points, across.expand(12, 3))
    assert not family.between(others, family.reference).any()
    assert torch.equal(family.own(others), family.own(family.reference))


@every_kind
@pytest.mark.parametrize("count", [4, 12])
def test_an_object_that_is_moved_turned_and_enlarged_has_the_same_kernels(kind, count):
    def move(points: torch.Tensor) -> torch.Tensor:
        return 7.0 * points @ turn().T + torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64)

    here = impacts(count, seed=1), impacts(9, seed=2)
    there = [Sites(move(each.points), each.directions @ turn().T) for each in here]
    found = made(kind, there[0], move, 7.0 * SIZE).between(*there)
    # The elastic family keeps shapes in single precision.
    torch.testing.assert_close(
        found, made(kind, here[0]).between(*here), rtol=0, atol=1e-5 if kind is Elastic else 1e-9
    )


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


def mean_of(family: ThinPlate, row: int, share: int, sites: Sites, values: torch.Tensor) -> torch.Tensor:
    """Return the Gaussian process's mean with one kernel and one noise share."""
    weights = torch.zeros(1, len(NOISE_SHARES), values.shape[1], dtype=torch.float64)
    weights[:, share] = 1.0
    kept = family.take(torch.tensor([row]))
    floor = torch.zeros(values.shape[1], dtype=torch.float64)
    process = KernelMixture(kept.kernels(), values, floor, weights)
    return process.average(kept.between(sites, family.reference), kept.own(sites), lambda mean, _: mean)[0]


@pytest.mark.parametrize(("dimensions", "count"), [(1, 9), (2, 14), (3, 16), (1, 3), (2, 5), (3, 7)])
@pytest.mark.parametrize("share", range(len(NOISE_SHARES)))
def test_the_thin_plate_mean_is_scipys_spline(dimensions, count, share):
    """But for the affine part, which shrinks by its share b of the variance to b / (b + noise)."""
    family, values = ThinPlate(alike(scattered(dimensions, count)), 0.4), draw(count, 2, seed=7)
    sites = alike(scattered(dimensions, 8, seed=6))
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


def test_visual_kernels_are_the_written_ones():
    """Features by the root mean square distance between those of points, alone and times those of positions."""
    # A line whose features repeat after half of it.
    along = torch.linspace(0.0, 1.0, 41)[:-1]
    points = along[:, None] * torch.tensor([1.0, 0.0, 0.0])
    features = torch.stack([(4 * torch.pi * along).cos(), (4 * torch.pi * along).sin()], dim=1)
    known = alike(points[::7].double())
    squares = torch.cdist(features.double(), features.double()).square()
    similar = [torch.exp(-0.5 * squares / squares.mean() / length**2)[::7, ::7] for length in (0.25, 0.5, 1.0)]
    apart = torch.cdist(known.points, known.points).square()
    near = [torch.exp(-0.5 * apart / length**2) for length in (0.2, 0.4, 0.8)]
    expected = torch.stack(similar + [one * other for one in near for other in similar])
    # Whatever the unit of the features.
    for unit in (1.0, 100.0):
        found = Visual(known, 1.0, points, unit * features).kernels()
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0.0)
