"""73 real photographs of a ceramic dinosaur: whose bounding box, axes and size are known."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import View
from avmsf.photographs.hull import carve

LOW, HIGH = (-0.0419, 0.0011, -0.0378), (0.0309, 0.0882, 0.0355)


@pytest.fixture(scope="module")
def dino(shared: Path) -> tuple[View, ...]:
    return read_views(shared / "dino", longest=320)


def corners() -> torch.Tensor:
    return torch.cartesian_prod(*torch.tensor([LOW, HIGH]).T.double())


def box_in(view: View) -> np.ndarray:
    """Where the bounding box lies in a view's image."""
    pixels = view.camera.project(corners())[0].numpy()
    outline = cv2.convexHull(np.round(pixels - 0.5).astype(np.int32))
    filled = np.zeros((view.camera.height, view.camera.width), dtype=np.uint8)
    cv2.fillConvexPoly(filled, outline, 1)
    return filled > 0


def test_all_photographs_are_read(dino: tuple[View, ...]) -> None:
    assert len(dino) == 73
    assert [view.name for view in dino] == sorted(view.name for view in dino)
    assert dino[0].camera.focal == (3310.4 / 2, 3325.5 / 2)


def test_the_bounding_box_covers_what_is_bright(dino: tuple[View, ...]) -> None:
    covered = [box_in(view)[view.image.numpy().max(axis=2) > 100].mean() for view in dino]
    # A pixel's blur at the box's faces, which touch the object.
    assert min(covered) > 0.995


def test_what_is_bright_in_all_views_fills_the_bounding_box(dino: tuple[View, ...]) -> None:
    """The shape that the photographs agree on ends where the box does: no axis is turned, no length is scaled."""
    masks = [view.image.numpy().max(axis=2) > 40 for view in dino]
    hull = carve(masks, [view.camera for view in dino])
    assert hull is not None
    inside = hull.grid.places(np.argwhere(hull.occupied(missing=2)))
    # Millimetres: shadows cost some, a cube is 1 mm, and a pixel 0.4 mm.
    assert np.abs(inside.min(axis=0) - LOW).max() < 4e-3
    assert np.abs(inside.max(axis=0) - HIGH).max() < 4e-3


@pytest.mark.slow
def test_the_foreground_is_the_dinosaur(dino: tuple[View, ...]) -> None:
    views = find_foreground(dino[::2])
    assert [view.name for view in views] == [view.name for view in dino[::2]]
    shares, dark = [], []
    for view in views:
        assert view.mask is not None
        mask, level = view.mask.numpy() > 127, view.image.numpy().max(axis=2)
        # Whatever is as bright as the ceramic's lit half is ceramic.
        assert mask[level > 90].mean() > 0.995, view.name
        # Next to nothing lies outside the bounding box: blur, and folds of cloth right behind its faces.
        assert (mask & ~cv2.dilate(box_in(view).astype(np.uint8), np.ones((7, 7))).astype(bool)).sum() < 40, view.name
        count, _, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        assert statistics[1:, cv2.CC_STAT_AREA].max() > 0.97 * mask.sum(), view.name
        shares.append(mask.mean())
        dark.append(mask[level < 20].sum() / mask.sum())
        assert count >= 2
    assert min(shares) > 0.15
    assert max(shares) < 0.55
    # Shadows are filled: some views have many dark pixels inside. The black between limbs is not: no view has a tenth.
    assert max(dark) > 0.01
    assert max(dark) < 0.1
