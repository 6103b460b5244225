"""A mesh beside photographs of it, of a larger one, of a displaced one and of one in another unit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from avmsf.capture import CaptureSettings
from avmsf.capture.settings import METRES
from avmsf.cli import main
from avmsf.errors import CaptureError
from avmsf.mesh import Surface
from avmsf.mesh.surface import write_surface
from avmsf.photographs.folder import write_frames
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.pipeline.frame_check import check_outlines, compare_outlines, expect_contacts_in_views
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.small_scene import slab, slab_views

VIEWS = slab_views(192)


def scaled(factor: float) -> Surface:
    return Surface(factor * slab().vertices, slab().faces)


def test_a_mesh_agrees_with_pictures_of_it_and_a_larger_one_differs_by_its_area() -> None:
    tracer = MeshTracer(slab())
    # A mask has the pixels that are more than half covered, an outline those whose middle is.
    assert compare_outlines(tracer, VIEWS).difference < 0.01
    # Half the outline's area more; all cameras look from afar at its middle, to which the mesh is moved.
    middle = (slab().vertices.amax(0) + slab().vertices.amin(0)) / 2
    grown = Surface(1.5**0.5 * (slab().vertices - middle) + middle, slab().faces)
    found = compare_outlines(MeshTracer(grown), VIEWS)
    assert found.difference == pytest.approx(1 / 3, abs=0.04)
    assert found.size == pytest.approx(1.5**0.5, rel=0.05)
    assert 0 < found.beyond < found.difference


def test_what_the_masks_pixels_or_a_tenth_of_wrong_masks_explain_is_not_spoken_of() -> None:
    settings = CaptureSettings()
    wrong = [
        replace(view, mask=torch.full_like(view.mask, 255)) if row % 10 == 0 else view for row, view in enumerate(VIEWS)
    ]
    for surface, views in ((slab(), VIEWS), (scaled(1.01), VIEWS), (slab(), wrong)):
        assert check_outlines(surface, views, settings) is None
    assert check_outlines(scaled(2.0), [replace(view, mask=None) for view in VIEWS], settings) is None


@pytest.mark.parametrize("surface", [scaled(1.1), scaled(0.9), Surface(slab().vertices + 0.02, slab().faces)])
def test_a_mesh_of_another_size_or_place_is_told(surface: Surface) -> None:
    warning = check_outlines(surface, VIEWS, CaptureSettings())
    assert warning.name == "surface"
    assert 0.05 < warning.value < 1.0


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_cameras_or_contacts_in_another_unit_are_refused_with_it(unit: str) -> None:
    """A mesh and contacts in meters, cameras in another unit that the settings do not name; and the other way round."""
    settings, factor, contacts = CaptureSettings(), METRES[unit], slab().vertices
    for each in (factor, 1 / factor):
        with raises(CaptureError, name="surface_unit", value=pytest.approx(1 / each)):
            check_outlines(scaled(each), VIEWS, settings)
    expect_contacts_in_views(contacts, VIEWS, settings)
    expect_contacts_in_views(contacts / factor, [replace(view, mask=None) for view in VIEWS], settings)
    with raises(CaptureError, name="unit", value=pytest.approx(factor)):
        expect_contacts_in_views(contacts / factor, VIEWS, settings)


def test_reconstruct_refuses_them_before_it_fits_gaussians(tmp_path: Path) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    write_surface(slab(), folder / "surface.ply")
    write_frames(slab_views(), folder)
    with open(folder / "capture.toml", "a") as file:
        file.write('views_unit = "cm"\n')
    assert main(["fit", str(folder), "--gain-model", "visual", "--set", "lift.encoder=descriptors"]) == 2
    assert not (folder / ".avmsf" / "cloud.ply").exists()
