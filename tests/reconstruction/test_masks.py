"""Shapes from masks that are too large, too small or wrong, and from views that do not bound the object."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SceneError
from avmsf.photographs.cameras import View
from avmsf.reconstruction import object_surface
from factories.looked_at import ball, depth_of, mesh_of, views_of

CELLS = 48
RADIUS = 0.05


def _grown(view: View, pixels: int) -> View:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    change = cv2.dilate if pixels > 0 else cv2.erode
    return replace(view, mask=torch.from_numpy(change(view.mask.numpy(), kernel)))


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [-2, 2])
def test_masks_that_are_all_too_large_or_too_small_leave_the_size_as_it_is(pixels: int) -> None:
    mesh = ball(RADIUS)
    views = [_grown(view, pixels) for view in views_of(mesh)]
    shape = object_surface(views, depth_of(mesh), cells=CELLS)
    # A pixel is 1 mm wide there.
    radii = np.linalg.norm(mesh_of(shape.solid()).vertices, axis=1)
    assert float(radii.mean()) == pytest.approx(RADIUS, abs=0.0005)
    assert shape.report.mask_offset == pytest.approx(pixels, abs=0.4)


@pytest.mark.slow
def test_a_mask_that_is_wrong_about_a_small_part_is_left_out() -> None:
    # Mirrored masks differ in the arm alone, which is a hundredth of the volume.
    arm = trimesh.creation.box((0.03, 0.012, 0.012))
    arm.apply_translation((0.05, 0.0, 0.02))
    mesh = trimesh.util.concatenate([trimesh.creation.cylinder(radius=0.04, height=0.06, sections=96), arm])
    views = list(views_of(mesh))
    wrong = (3, 9)
    for row in wrong:
        views[row] = replace(views[row], mask=views[row].mask.flip((0, 1)).clone())
    shape = object_surface(views, depth_of(mesh), cells=CELLS)
    assert set(shape.report.rejected) == {views[row].name for row in wrong}
    assert float(shape.solid().vertices[:, 0].max()) == pytest.approx(0.065, abs=0.002)


def test_views_from_one_side_are_refused() -> None:
    mesh = ball(RADIUS)
    views = views_of(mesh, elevations=(0.0,), azimuths=72)[:3]
    with pytest.raises(SceneError):
        object_surface(views, depth_of(mesh), cells=CELLS)
