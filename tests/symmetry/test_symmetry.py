"""Symmetries as values: turns and reflections in closed form, what they say, and the way to JSON and back."""

import json
import math

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.raising import raises

THIRD = RotationalSymmetry(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([1.0, 0.0, 0.5]).double(), 3, 0.04)
ROUND = RotationalSymmetry(torch.tensor([0.0, 1.0, 0.0]).double(), torch.zeros(3).double(), None, 0.1)
PLANE = MirrorSymmetry(torch.tensor([0.6, 0.8, 0.0]).double(), torch.tensor([0.6, 0.8, 0.0]).double(), 0.32)
FOUND = Symmetries((ROUND, THIRD), (PLANE,), 0.0021, 0.35, math.inf)


def test_a_quarter_turn_about_a_shifted_axis_goes_counter_clockwise():
    points = torch.tensor([[2.0, 0.0, 7.0], [1.0, 0.0, -3.0]]).double()
    # Points on the axis stay.
    expected = torch.tensor([[1.0, 1.0, 7.0], [1.0, 0.0, -3.0]]).double()
    assert torch.allclose(THIRD.turn(points, math.pi / 2), expected, atol=1e-15)
    assert THIRD.turn(points.float(), 0.3).dtype == torch.float32
    assert THIRD.angles(36) == pytest.approx([0.0, 2 * math.pi / 3, 4 * math.pi / 3])
    assert ROUND.angles(4) == pytest.approx([0.0, math.pi / 2, math.pi, 3 * math.pi / 2])


def test_a_reflection_keeps_the_plane_and_swaps_its_sides():
    # The plane's distance from the origin is 1: the origin goes to twice the normal.
    points = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.8, 4.0]]).double()
    assert torch.allclose(PLANE.reflect(points), torch.tensor([[1.2, 1.6, 0.0], [0.6, 0.8, 4.0]]).double(), atol=1e-15)


def test_symmetries_go_through_json_to_the_last_bit():
    axis = torch.randn(3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    odd = RotationalSymmetry(axis / axis.norm(), axis, 7, 0.1 / 3)
    for rejected in (math.inf, 1.7):
        stored = Symmetries((odd, ROUND), (PLANE,), 0.1, 0.35, rejected)
        read = Symmetries.from_dict(json.loads(json.dumps(stored.to_dict(), allow_nan=False)))
        assert torch.equal(read.rotations[0].axis, odd.axis)
        assert torch.equal(read.rotations[0].point, odd.point)
        assert torch.equal(read.mirrors[0].normal, PLANE.normal)
        assert [each.order for each in read.rotations] == [7, None]
        assert read.to_dict() == stored.to_dict()
        assert read.rejected == rejected


@pytest.mark.parametrize(
    "change",
    [
        {"rotations": 3},
        {"mirrors": [{"normal": [1, 0], "point": [0, 0, 0], "error": 0.1}]},
        {"mirrors": [{"normal": [2, 0, 0], "point": [0, 0, 0], "error": 0.1}]},
        {"mirrors": [{"normal": [1, 0, 0], "point": [0, math.nan, 0], "error": 0.1}]},
        {"spacing": None},
        {"rotations": [{"axis": [1, 0, 0], "point": [0, 0, 0], "order": 1, "error": 0.1}]},
    ],
)
def test_stored_symmetries_that_are_none_are_refused(change):
    with raises(SceneError, name="symmetries", value=None):
        Symmetries.from_dict(FOUND.to_dict() | change)


def test_the_summary_has_a_line_for_each_and_one_for_the_limit():
    assert len(FOUND.summary().splitlines()) == 4
    none = Symmetries((), (), 0.002, 0.35, 0.81)
    assert "0.81" in none.summary()
    assert (bool(none), bool(FOUND)) == (False, True)
