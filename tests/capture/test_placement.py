"""Contacts on and off a surface, and mistakes that the test makes and that must be named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avmsf.capture import CaptureSettings
from avmsf.capture.checks import check_surface, find_surface
from avmsf.capture.placement import FACTORS, check_placement
from avmsf.capture.table import Impact, parse_row, read_rows
from avmsf.errors import CaptureError
from avmsf.mesh import Surface
from avmsf.mesh.surface import contacted_part, surface_points
from factories.looked_at import surface_of
from factories.made_sheet import sheet_over
from factories.raising import raises

Y_UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
"""Takes (x, y, z) of a file with y upwards to one with z upwards."""


PARTS = (((0.3, 0.04, 0.1), (0.1, 0, 0)), ((0.05, 0.2, 0.06), (0.2, 0.1, 0)), ((0.04, 0.06, 0.2), (0, 0, 0.1)))
"""Sizes and places of three boxes."""


def object_points(count: int, *, seed: int) -> torch.Tensor:
    """Points on a thing without symmetry, 0.43 m across, off the origin."""
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(place)) for size, place in PARTS]
    mesh = trimesh.util.concatenate(boxes)
    return torch.from_numpy(np.array(trimesh.sample.sample_surface(mesh, count, seed=seed)[0]))


CLOUD = object_points(6000, seed=0)
CONTACTS = object_points(20, seed=1)


@pytest.mark.parametrize("error", [0.0, 0.005, 0.01, 0.02])
def test_contacts_on_the_surface_pass_and_coarse_measurements_are_no_mistake_of_all(error: float) -> None:
    noise = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    placement = check_placement(CONTACTS + error * 0.43 * noise, CLOUD)
    assert placement.mismatch is None
    if error == 0.0:
        assert placement.fault == "none"
        assert placement.describe() == ""
        # Points of a cloud of 6000 on .15 m^2 lie 5 mm apart.
        assert float(placement.distances.max()) < 0.01


def test_distances_are_meters_to_the_nearest_point() -> None:
    cloud = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2]])
    placement = check_placement(torch.tensor([[1.0, 0.3, 0.4], [0, 2, 0.25]]), cloud)
    assert placement.distances.tolist() == pytest.approx([0.5, 0.25])
    assert placement.diagonal == pytest.approx(3)


# Contacts on a surface three times too large look like contacts on a part of it.
@pytest.mark.parametrize("factor", [factor for factor in FACTORS if factor < 1 or factor > 9])
def test_every_ratio_of_units_is_found_whichever_of_the_two_it_befell(factor: float) -> None:
    placement = check_placement(CONTACTS, CLOUD * factor)
    assert placement.mismatch.factor == pytest.approx(factor)
    assert placement.mismatch.unit_only


def test_a_surface_in_millimeters_is_told_even_if_all_contacts_lie_near_one_of_its_corners() -> None:
    cloud = 1000 * (CLOUD - CLOUD[0])
    placement = check_placement(CONTACTS - CLOUD[0], cloud)
    assert not placement.off
    assert placement.fault != "none"
    assert "multiplied by 1000" in placement.describe()
    assert 'is the surface\'s unit "mm"?' in placement.describe()


EYE, HERE = torch.eye(3, dtype=torch.float64), (0.0, 0.0, 0.0)
MISTAKES = {
    "inches": (0.0254, EYE, HERE, 'is their unit "in"?', True),
    "y up": (1.0, Y_UP, HERE, "(x, -z, y)", True),
    "z up for y up": (1.0, Y_UP.T, HERE, "(x, z, -y)", True),
    "upside down": (1.0, torch.diag(EYE.new_tensor([1, -1, -1])), HERE, "(x, -y, -z)", True),
    "mirrored": (1.0, torch.diag(EYE.new_tensor([-1, 1, 1])), HERE, "mirrored?", True),
    "other origin": (1.0, EYE, (0.7, -0.2, 0.4), "moved by (0.", True),
    "displaced by 4 %": (1.0, EYE, (0.017, 0.0, 0.0), "moved by (0.0", False),
    "unit, axes and origin": (1e-3, Y_UP, (0.5, 0.1, -0.3), 'multiplied by 0.001 (is their unit "mm"?), with', True),
    "12 % too small": (1.12, EYE, HERE, "multiplied by 1.1", False),
    "7.3 times too small": (7.3, EYE, HERE, "multiplied by 7", True),
}
"""What contacts are to be multiplied by, turned by and moved by, the words for it, and whether no shape can be used."""


@pytest.mark.parametrize(("factor", "axes", "shift", "words", "misplaced"), MISTAKES.values(), ids=MISTAKES)
def test_what_befell_all_contacts_is_named_with_its_undoing(factor, axes, shift, words, misplaced):
    contacts = (CONTACTS - torch.tensor(shift, dtype=torch.float64)) @ axes / factor
    placement = check_placement(contacts, CLOUD)
    mismatch = placement.mismatch
    # Units are exact, another scale is fitted.
    assert mismatch.factor == pytest.approx(factor, rel=1e-9 if factor <= 1 else 0.02)
    assert np.array_equal(mismatch.axes, axes)
    assert mismatch.unit_only == (axes is EYE and shift is HERE)
    # A few spacings of the points on an object .43 m across.
    assert np.linalg.norm(mismatch.undo(contacts.numpy()) - CONTACTS.numpy(), axis=1).mean() < 0.01
    assert (placement.fault in ("frame", "unit")) == misplaced
    assert words in placement.describe()
    assert "row" not in placement.describe()


def test_one_wrong_row_is_no_mistake_of_all() -> None:
    contacts = CONTACTS.clone()
    contacts[7] = contacts[7] + torch.tensor([0.0, 1.0, 0.0])
    placement = check_placement(contacts, CLOUD)
    assert placement.mismatch is None
    assert placement.off == (7,)
    assert "1 of 20 contacts" in placement.describe()
    assert placement.describe().endswith("check row 7")
    names = [f"impact {row + 2}" for row in range(20)]
    assert placement.describe(names).endswith("check impact 9")


@pytest.mark.slow
def test_contacts_of_another_object_are_not_explained() -> None:
    generator = torch.Generator().manual_seed(0)
    explained = 0
    for _ in range(10):
        contacts = 0.3 * torch.randn(12, 3, dtype=torch.float64, generator=generator)
        placement = check_placement(contacts, CLOUD)
        assert placement.fault != "none"
        explained += placement.mismatch is not None
        assert (placement.mismatch is None) == ("in different frames" in placement.describe())
    # 48 axes, 13 units and a shift explain a few random contacts now and then.
    assert explained <= 1


def test_few_contacts_close_together_or_on_few_points_are_judged_too() -> None:
    near = CLOUD[(CLOUD - CLOUD[0]).norm(dim=1).argsort()[:3]]
    corners = torch.tensor(trimesh.creation.box((0.2, 0.2, 0.2)).vertices)
    for contacts, points, fault in (
        (CONTACTS[:1].repeat(9, 1), CLOUD, "none"),
        (CONTACTS[:1].repeat(9, 1) + 0.2, CLOUD, "frame"),
        # A spot that is too small, not another frame.
        (near, CLOUD, "rows"),
        (torch.tensor([[0.1, 0.02, 0.0], [0.0, 0.1, 0.0]]), corners, "none"),
    ):
        placement = check_placement(contacts, points)
        assert placement.fault == fault
        assert "different frames" not in placement.describe()


@pytest.mark.parametrize(
    ("contacts", "points", "name", "value"),
    [
        (torch.zeros(0, 3), CLOUD, "contacts", 0),
        (torch.full((2, 3), torch.nan), CLOUD, "contacts", 2),
        (CONTACTS, torch.ones(5, 3), "points", 0.0),
    ],
)
def test_nothing_to_judge_is_refused(contacts: torch.Tensor, points: torch.Tensor, name: str, value: float) -> None:
    with raises(CaptureError, name=name, value=value):
        check_placement(contacts, points)


def test_the_aircrafts_contacts_lie_on_it_and_its_mistakes_are_named(shared: Path) -> None:
    strikes = [parse_row(row, CaptureSettings()) for row in read_rows(shared / "aircraft")[0]]
    contacts = torch.tensor([strike.contact for strike in strikes], dtype=torch.float64)
    points = surface_points(Surface.read(shared / "aircraft/surface.obj"))
    placement = check_placement(contacts, points)
    assert placement.fault == "none"
    assert float(placement.distances.max()) < 0.01
    assert "(x, -z, y)" in check_placement(contacts @ Y_UP, points).describe()


def test_first_impacts_near_the_middle_of_a_plate_are_no_other_unit() -> None:
    plate = surface_points(sheet_over(np.array([-0.5, 0.5]), np.array([-0.5, 0.5])))
    first = torch.tensor([[0.02, 0.0, 0.0], [-0.02, 0.01, 0.0]])
    assert check_placement(first, plate).fault != "unit"
    patch = 0.1 * (torch.rand(8, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * torch.tensor([1.0, 1.0, 0.0])
    assert check_placement(patch, plate).fault != "unit"
    assert check_placement(0.01 * patch, plate).fault == "unit"
    assert check_placement(1000 * patch, plate).fault == "unit"


def test_of_a_scan_with_its_table_the_part_that_the_contacts_lie_on_is_kept() -> None:
    cup, table = trimesh.creation.icosphere(3, radius=0.05), trimesh.creation.box((0.5, 0.5, 0.02))
    table.apply_translation((0, 0, -0.07))
    both = trimesh.util.concatenate([table, cup])
    scan = surface_of(both)
    contacts = torch.from_numpy(np.array(trimesh.sample.sample_surface(cup, 12, seed=0)[0]))
    # What is left of the scan is checked against them as any other surface.
    impacts = [Impact(f"{row}.wav", tuple(each), line=row + 2) for row, each in enumerate(contacts.tolist())]
    far = replace(impacts[3], contact=(0.0, 0.0, 5.0))
    with raises(CaptureError, row=5):
        check_surface([*impacts[:3], far, *impacts[4:]], scan, settings=CaptureSettings())
    kept, areas = contacted_part(scan, contacts)
    assert len(kept.faces) == len(cup.faces)
    assert areas == pytest.approx([cup.area, table.area])
    on_both = torch.cat([contacts, torch.tensor([[0.2, 0.2, -0.06], [-0.2, 0.2, -0.06]])])
    assert contacted_part(scan, on_both)[1] == []
    on_table = contacts * torch.tensor([3.0, 3.0, 0.0]) + torch.tensor([0.0, 0.0, -0.06])
    assert contacted_part(scan, on_table)[1] == []


def test_an_arbitrary_frame_is_called_one() -> None:
    turn, shift = Rotation.from_euler("zyx", [28, 15, -40], degrees=True).as_matrix(), np.array([0.3, 0.1, -0.2])
    moved = torch.from_numpy(2.9 * CLOUD.numpy() @ turn.T + shift)
    placement = check_placement(CONTACTS, moved)
    assert placement.fault == "frame"
    assert "different frames" in placement.describe(what="Gaussians")


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_vertices_of_no_triangle_are_no_part_of_the_object(tmp_path: Path, suffix: str) -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    trimesh.Trimesh([*box.vertices, (2.0, 2.0, 2.0)], box.faces, process=False).export(tmp_path / f"surface.{suffix}")
    surface = find_surface(tmp_path, CaptureSettings())
    assert surface is not None
    assert (len(surface.vertices), float(surface.vertices.amax())) == (8, pytest.approx(0.05))
