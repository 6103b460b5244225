"""The surface around what a grid's values enclose: closed, in place, and as coarse as asked for."""

import numpy as np
import pytest
import trimesh

from avmsf.errors import CaptureError
from avmsf.mesh.level_set import enclose
from avmsf.mesh.surface import Surface
from factories.raising import raises

RADIUS, SPACING, CELLS = 0.05, 0.0025, 52
MIDDLE = np.array([0.3, -0.2, 0.1])
LOWEST = MIDDLE - 0.5 * (CELLS - 1) * SPACING


def places() -> np.ndarray:
    """Return where the grid's values lie, meters."""
    rows = np.stack(np.meshgrid(*[np.arange(CELLS)] * 3, indexing="ij"), axis=-1)
    return LOWEST + SPACING * rows


def ball(faces: int | None = None) -> Surface:
    """Return the surface of a ball that fades from one to zero across its skin."""
    depth = RADIUS - np.linalg.norm(places() - MIDDLE, axis=-1)
    values = np.clip(0.5 + 0.5 * depth / (2 * SPACING), 0, 1).astype(np.float32)
    return enclose(values, 0.5, lowest=LOWEST, spacing=SPACING, faces=faces)


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)


def off(surface: Surface) -> np.ndarray:
    """Return how far the vertices lie off the ball, meters."""
    return np.abs(np.linalg.norm(surface.vertices.numpy() - MIDDLE, axis=1) - RADIUS)


def test_a_ball_comes_back_closed_and_right_side_out() -> None:
    surface = ball()
    mesh = mesh_of(surface)
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # Between two values the ramp is nearly straight: a twentieth of a cell.
    assert off(surface).max() < 0.05 * SPACING
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)


def test_fewer_triangles_are_still_the_ball() -> None:
    surface = ball(faces=1500)
    assert len(surface.faces) <= 1500
    assert mesh_of(surface).is_watertight
    # The sagitta of triangles 5 mm wide is .1 mm.
    assert np.quantile(off(surface), 0.95) < 3e-4


def test_a_ring_keeps_its_hole() -> None:
    x, y, z = np.moveaxis(places() - MIDDLE, -1, 0)
    depth = 0.015 - np.hypot(np.hypot(x, y) - 0.035, z)
    values = np.clip(0.5 + depth / (4 * SPACING), 0, 1).astype(np.float32)
    mesh = mesh_of(enclose(values, 0.5, lowest=LOWEST, spacing=SPACING))
    assert mesh.is_watertight
    assert mesh.euler_number == 0


def test_specks_beside_the_body_are_left_out() -> None:
    values = np.zeros((40, 20, 20), dtype=np.float32)
    values[5:15, 5:15, 5:15] = 1.0
    values[30, 10, 10] = 1.0
    surface = enclose(values, 0.5, lowest=np.array([1.0, 2.0, 3.0]), spacing=0.1)
    # Half a cell around the solid ones.
    assert surface.vertices.amin(0).tolist() == pytest.approx([1.45, 2.45, 3.45])
    assert surface.vertices.amax(0).tolist() == pytest.approx([2.45, 3.45, 4.45])


def test_what_encloses_nothing_or_reaches_the_edge_is_refused() -> None:
    empty, full = np.zeros((8, 8, 8), dtype=np.float32), np.ones((8, 8, 8), dtype=np.float32)
    for values in (empty, full):
        with raises(CaptureError, name="values", value=[values.min(), values.max()]):
            enclose(values, 0.5, lowest=np.zeros(3), spacing=0.1)
