"""Cavities that no view saw into: behind faces that no outline touches there may be a wall, or none."""

import numpy as np
import pytest
import trimesh

from avmsf.reconstruction import ObjectShape, object_surface
from factories.looked_at import cup, depth_of, mesh_of, views_of

RADIUS, HEIGHT = 0.03, 0.05


def shape_of(mesh: trimesh.Trimesh) -> ObjectShape:
    return object_surface(views_of(mesh), depth_of(mesh), cells=48)


@pytest.fixture(scope="module")
def block() -> ObjectShape:
    """Return a cylinder as views show it; a tube whose ends are covered looks the same."""
    return shape_of(trimesh.creation.cylinder(radius=RADIUS, height=HEIGHT, sections=96))


def test_both_ends_of_a_cylinder_may_be_open(block: ObjectShape) -> None:
    assert block.supposed
    assert int(block.hollow.max()) == 2
    for number in (1, 2):
        # An opening is smaller than the end by the reach of its edge; a cavity is a cell deep.
        area = int((block.hollow == number).sum()) * block.grid.spacing**2
        assert 0.7 * np.pi * RADIUS**2 < area < np.pi * RADIUS**2
    # What the views show is the block itself.
    assert mesh_of(block.as_seen()).volume == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=0.03)


@pytest.mark.parametrize("wall", [0.002, 0.004])
def test_the_wall_around_a_supposed_cavity_is_a_tube(block: ObjectShape, wall: float) -> None:
    mesh = mesh_of(block.shell(wall))
    assert mesh.is_watertight
    # The outer side of the hull is up to 1 % too wide, and the tube's ends are rounded.
    assert mesh.volume == pytest.approx(np.pi * HEIGHT * (RADIUS**2 - (RADIUS - wall) ** 2), rel=0.1)


def test_views_do_not_bound_the_wall_of_a_supposed_cavity(block: ObjectShape) -> None:
    assert block.thickness_range == pytest.approx((0.0025 * block.diagonal, 0.06 * block.diagonal))
    # Into an open cup of a wall of 4 mm they do see.
    open_cup = shape_of(cup(wall=0.004))
    assert not open_cup.supposed
    assert open_cup.thickness_range is not None
    assert open_cup.thickness_range[1] < 0.06 * open_cup.diagonal
