import numpy as np
import pytest

from avmsf.reconstruction.distance import distance_from

RADIUS = 8.3


def _ball() -> np.ndarray:
    places = np.stack(np.meshgrid(*[np.arange(25.0)] * 3, indexing="ij"), axis=-1)
    return (RADIUS - np.linalg.norm(places - 12.2, axis=-1)).astype(np.float32)


def test_distances_from_a_ball_are_exact_within_a_tenth_of_a_cell() -> None:
    values = _ball()
    found = distance_from(np.clip(values, -2.5, 2.5))
    off = np.abs(found - np.abs(values))
    assert off.mean() < 0.03
    assert np.quantile(off, 0.99) < 0.1


def test_a_part_that_is_left_out_is_no_surface() -> None:
    values = _ball()
    upper = np.zeros(values.shape, dtype=bool)
    upper[12:] = True
    found = distance_from(values, upper)
    # The nearest place of the lower half, from the top of the ball, is on its rim.
    assert found[20, 12, 12] == pytest.approx(np.hypot(RADIUS, 8.0), abs=0.8)
    assert np.isinf(distance_from(values, np.ones(values.shape, dtype=bool))).all()
