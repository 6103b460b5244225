"""What the surface is like about a point: closed forms on planes and balls, and blindness to pose."""

import numpy as np
from scipy.spatial.transform import Rotation

from avmsf.mesh.neighborhoods import describe_neighborhoods, read_neighborhoods

GRID = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


def ball(count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_planes_normals_and_spacing():
    surface = read_neighborhoods(0.01 * GRID)
    assert np.allclose(np.abs(surface.normals[:, 2]), 1.0)
    inner = (np.abs(GRID[:, :2] - 19.5) < 10).all(axis=1)
    # The 24th neighbor's circle need not hold 24 cells exactly: between its rings of neighbors it is 10 % off.
    assert np.allclose(surface.spacing[inner], 0.01, rtol=0.1)


def test_a_balls_normals_are_radial_and_noise_is_averaged_away():
    random, clean = np.random.default_rng(1), ball()
    surface = read_neighborhoods(clean + 0.02 * random.normal(size=clean.shape))
    across = np.abs(
        np.einsum("ni,ni->n", surface.normals, surface.points / np.linalg.norm(surface.points, axis=1)[:, None])
    )
    assert np.median(across) > 0.995
    radius = np.linalg.norm(surface.points, axis=1)
    # A plane through 24 points leaves about a fifth of the noise; it lies inside the ball by a hundredth of the radius.
    assert radius.std() < 0.4 * 0.02
    assert abs(radius.mean() - 1.0) < 0.02
    # 4 pi over 4000 points, as the side of a square.
    assert abs(np.median(read_neighborhoods(clean).spacing) / np.sqrt(4 * np.pi / 4000) - 1.0) < 0.1


def test_descriptors_do_not_know_pose_or_side():
    random = np.random.default_rng(2)
    points = ball(1500) * np.array([1.0, 0.7, 0.4])
    points = points[points[:, 0] + points[:, 1] < 0.8]
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    rows, others = np.arange(0, len(points), 5), np.arange(len(points))
    first = describe_neighborhoods(read_neighborhoods(points), rows, others, diagonal=diagonal)
    turned = Rotation.random(random_state=3).apply(points * np.array([-1.0, 1.0, 1.0])) * 7.0 + random.normal(size=3)
    second = describe_neighborhoods(read_neighborhoods(turned), rows, others, diagonal=7.0 * diagonal)
    # Histograms jump where rounding moves a point over a bin's edge.
    assert (np.abs(first - second) < 1e-6).mean() > 0.99
    # They do tell places apart: the flat sides from the tips.
    assert (np.abs(first).max(axis=0) > 1.0).mean() > 0.7
