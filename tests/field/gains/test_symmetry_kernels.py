"""Kernels of an object's symmetries: closed forms, positive semidefinite, the same in any pose, and kept in files."""

import math

import pytest
import torch

from avmsf.field.gains import symmetry
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites, ThinPlate
from avmsf.field.gains.symmetry import Symmetric
from avmsf.symmetry.characters import groups_of
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries

SIZE = 1.0


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def mirror(normal: torch.Tensor, point: torch.Tensor) -> MirrorSymmetry:
    return MirrorSymmetry(normal, point, 0.0)


def of(*found: MirrorSymmetry | RotationalSymmetry) -> Symmetries:
    mirrors = tuple(each for each in found if isinstance(each, MirrorSymmetry))
    turns = tuple(each for each in found if isinstance(each, RotationalSymmetry))
    return Symmetries(turns, mirrors, 0.01, 0.38, math.inf)


CENTER = vector(0.1, -0.2, 0.3)
X = mirror(vector(1, 0, 0), CENTER)
Y = mirror(vector(0, 1, 0), CENTER)
TURN = RotationalSymmetry(vector(0, 0, 1), CENTER, 4, 0.0)


def impacts(count: int, seed: int = 0) -> Sites:
    generator = torch.Generator().manual_seed(seed)
    points = CENTER + 0.5 * (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return Sites(points, torch.nn.functional.normalize(directions, dim=1))


def reflected(sites: Sites) -> Sites:
    across = vector(-1, 1, 1)
    return Sites(CENTER + (sites.points - CENTER) * across, sites.directions * across)


def test_kernels_are_the_written_ones() -> None:
    """Of one mirror: thin plates of all images, the impacts' and the moved ones', with signs of both characters."""
    known, others = impacts(9), impacts(5, seed=1)
    plate = ThinPlate(Sites.joined([known, reflected(known)]), SIZE)

    def written(one: Sites, other: Sites, sign: float, share: float, row: int) -> torch.Tensor:
        same, moved = (plate.between(one, each)[row] for each in (other, reflected(other)))
        return (1.0 - share) * (same + sign * moved) / 2.0 + share * same

    found = Symmetric(known, SIZE, groups_of(of(X)), directional=True).between(others, known)
    rows = [(share, sign, row) for share in symmetry.RESIDUALS for sign in (1.0, -1.0) for row in range(3)]
    assert len(found) == len(rows)
    for kernel, (share, sign, row) in zip(found, rows, strict=True):
        whole, part = (written(known, known, sign, each, row).diagonal().mean() for each in (1.0, 0.0))
        # Each part is scaled to a mean of one by itself.
        expected = (1.0 - share) * written(others, known, sign, 0.0, row) / part
        expected = expected + share * written(others, known, sign, 1.0, row) / whole
        torch.testing.assert_close(kernel, expected, atol=1e-9, rtol=1e-9)


def test_characters_of_a_group_sum_to_the_kernel_itself() -> None:
    for group in groups_of(of(X, Y, TURN)):
        order = len(group.motions)
        if len(group.characters) == order:
            torch.testing.assert_close(
                group.characters @ group.characters.T, order * torch.eye(order, dtype=torch.float64)
            )
        assert bool((group.characters[0] == 1).all())


def test_motions_of_a_group_are_closed_though_the_planes_found_are_not_quite_perpendicular() -> None:
    tilted = mirror(torch.nn.functional.normalize(vector(0.03, 1, 0.02), dim=0), CENTER)
    groups = groups_of(of(X, tilted))
    assert [len(group.motions) for group in groups] == [2, 2, 4]
    whole = torch.cat([groups[2].motions, vector(0, 0, 0, 1).expand(4, 1, 4)], dim=1)
    for one in whole:
        for other in whole:
            assert float((whole - one @ other).abs().amax((1, 2)).min()) < 1e-12


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["even", "odd"])
def test_gains_on_the_other_side_are_those_of_the_mirrored_contact_with_the_modes_sign(sign, monkeypatch):
    monkeypatch.setattr(symmetry, "RESIDUALS", (0.0,))
    near = impacts(6, seed=2)
    points = torch.cat([CENTER + (near.points - CENTER).abs(), reflected(near).points[:3]])
    near = Sites(points[:6], near.directions)
    images = reflected(near).take(torch.arange(3))
    known = Sites.joined([near, images])
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(6, 4, generator=generator, dtype=torch.complex128)
    # Contacts 0 to 2 are struck on both sides, which gives the sign; 3 to 5 on one alone.
    family = Symmetric(known, SIZE, groups_of(of(X)), directional=True)
    ones = torch.ones(4, dtype=torch.float64)
    gains = MeasuredGains(torch.cat([values, sign * values[:3]]), 0.0 * ones, 100.0 * ones.cumsum(0), ones)
    model = fit_mixture([family], gains, known.points.float(), directional=True)
    beyond = reflected(near).take(torch.arange(3, 6))
    here = near.take(torch.arange(3, 6))
    there, own = (model.predict(each.points, each.directions).mean for each in (beyond, here))
    assert float(own.abs().max()) > 0.1
    torch.testing.assert_close(there, sign * own)


def test_functions_that_vanish_at_all_contacts_are_left_out() -> None:
    on_plane = impacts(6)
    on_plane.points[:, 0] = CENTER[0]
    upright = Sites(on_plane.points, vector(0, 0, 1).expand(6, 3))
    family = Symmetric(upright, SIZE, groups_of(of(X)), directional=True)
    aside = Sites(upright.points + vector(0.1, 0, 0), upright.directions)
    assert float(family.own(aside).max()) < 10.0
    assert len(family.shares) == 6  # Three thin plates, two remainders, even functions alone.
