"""Written views are read back as they were."""

from pathlib import Path

import pytest
import torch

from avmsf.errors import CaptureError
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.folder import read_views, write_views
from factories.raising import raises


def some_views(*, masked: bool = True) -> tuple[View, ...]:
    generator = torch.Generator().manual_seed(0)
    views = []
    for number in range(4):
        position = torch.randn(3, generator=generator, dtype=torch.float64)
        up = torch.tensor([0.0, 0.0, 1.0])
        camera = Camera.looking(
            3 * position / position.norm(), torch.zeros(3), up=up, focal=40.0 + number, width=24, height=17
        )
        image = torch.randint(0, 256, (17, 24, 3), generator=generator, dtype=torch.uint8)
        mask = torch.randint(0, 256, (17, 24), generator=generator, dtype=torch.uint8)
        views.append(View(f"side/{number}.jpg", image, camera, mask if masked else None))
    return tuple(views)


@pytest.mark.parametrize("masked", [True, False])
def test_views_are_read_back_as_they_were(tmp_path: Path, masked: bool) -> None:
    views = some_views(masked=masked)
    write_views(views, tmp_path / "views")
    for before, after in zip(views, read_views(tmp_path / "views"), strict=True):
        assert after.name == before.name.replace(".jpg", ".png")
        assert torch.equal(after.image, before.image)
        assert (after.mask is None) == (not masked)
        if before.mask is not None and after.mask is not None:
            assert torch.equal(after.mask, before.mask)
        assert after.camera.focal == before.camera.focal
        assert after.camera.principal == before.camera.principal
        # Two inversions in float64, of matrices of size 3.
        assert (after.camera.world_to_camera - before.camera.world_to_camera).abs().max() < 1e-12


def test_views_of_one_name_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    views = some_views()
    with raises(CaptureError, file="views", name="side/0.png"):
        write_views([views[0], views[0]], tmp_path / "views")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with raises(CaptureError, file=tmp_path):
        write_views(some_views(), tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["mine.txt"]
