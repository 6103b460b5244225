"""Similarities in closed form, against those that the test makes."""

import math

import pytest
import torch

from avmsf.errors import CaptureError
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.similarity import Similarity, align_similarity, move_views
from factories.raising import raises


def turn(seed: int) -> torch.Tensor:
    """A random proper rotation."""
    q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    return q * torch.sign(torch.linalg.det(q))


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("count", [3, 4, 30])
@pytest.mark.parametrize("seed", range(4))
def test_the_similarity_that_moved_the_points_is_found(count: int, seed: int) -> None:
    true = Similarity(0.037, turn(seed), torch.tensor([0.4, -3.0, 12.0], dtype=torch.float64))
    source = cloud(count, seed)
    found = align_similarity(source, true.apply(source))
    # Rounding in float64 of numbers near 10.
    assert found.scale == pytest.approx(true.scale, rel=1e-12)
    assert torch.allclose(found.rotation, true.rotation, rtol=0, atol=1e-11)
    assert torch.allclose(found.apply(source), true.apply(source), rtol=0, atol=1e-12)


def test_no_other_similarity_is_nearer_to_noisy_points() -> None:
    source = cloud(12)
    target = 2.5 * source @ turn(1).T + 0.3 * cloud(12, 7)
    best = align_similarity(source, target)

    def misfit(similarity: Similarity) -> float:
        return float((similarity.apply(source) - target).square().sum())

    least = misfit(best)
    angle = torch.tensor(0.01, dtype=torch.float64)
    for axis in range(3):
        tilt = torch.eye(3, dtype=torch.float64)
        one, other = (axis + 1) % 3, (axis + 2) % 3
        tilt[one, one] = tilt[other, other] = torch.cos(angle)
        tilt[one, other], tilt[other, one] = -torch.sin(angle), torch.sin(angle)
        for change in (tilt, tilt.T):
            assert misfit(Similarity(best.scale, change @ best.rotation, best.translation)) > least
        for step in (-0.01, 0.01):
            shift = best.translation.clone()
            shift[axis] += step
            assert misfit(Similarity(best.scale, best.rotation, shift)) > least
    for factor in (0.99, 1.01):
        assert misfit(Similarity(best.scale * factor, best.rotation, best.translation)) > least


def test_a_mirrored_copy_is_never_taken_for_a_turn() -> None:
    source = cloud(10)
    found = align_similarity(source, source * torch.tensor([1.0, 1.0, -1.0]))
    assert float(torch.linalg.det(found.rotation)) == pytest.approx(1)


def test_what_leaves_the_rotation_open_is_refused() -> None:
    with raises(CaptureError, name="points", value=[2, 2]):
        align_similarity(cloud(2), cloud(2))
    line = torch.arange(5.0)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    with raises(CaptureError, name="source", value=5):
        align_similarity(line, cloud(5))
    with raises(CaptureError, name="target", value=5):
        align_similarity(cloud(5), line)
    with raises(CaptureError, name="source", value=None):
        align_similarity(cloud(3) / 0, cloud(3))


def test_moved_cameras_see_moved_points_where_they_saw_them() -> None:
    position, target = torch.tensor([0.3, -1.0, 0.7]), torch.tensor([0.1, 0.0, 0.0])
    camera = Camera.looking(position, target, up=torch.tensor([0.0, 0.0, 1.0]), focal=90.0, width=40, height=30)
    view = View("a.png", torch.zeros(30, 40, 3, dtype=torch.uint8), camera)
    similarity = Similarity(0.2, turn(5), torch.tensor([3.0, 1.0, -2.0], dtype=torch.float64))
    (moved,) = move_views([view], similarity)
    points = 0.3 * cloud(20)
    pixels, depth = camera.project(points)
    again, deep = moved.camera.project(similarity.apply(points))
    assert torch.allclose(again, pixels, rtol=0, atol=1e-9)
    assert torch.allclose(deep, 0.2 * depth, rtol=1e-12)
    assert torch.allclose(moved.camera.position, similarity.apply(position[None])[0], rtol=0, atol=1e-9)
    turned = moved.camera.world_to_camera[:3, :3]
    assert float((turned @ turned.T - torch.eye(3)).norm()) < 1e-12
    assert math.isclose(float(torch.linalg.det(turned)), 1.0)
