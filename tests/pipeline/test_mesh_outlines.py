"""A mesh beside photographs of it, of a larger one, of a displaced one and of one in another unit."""

import shutil
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
from avmsf.photographs.folder import write_views
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.pipeline.frame_check import check_outlines, compare_outlines, expect_contacts_in_views
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.small_scene import slab, slab_views

Streams = pytest.CaptureFixture[str]
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


def test_what_the_masks_pixels_explain_is_not_spoken_of() -> None:
    settings = CaptureSettings()
    assert check_outlines(slab(), VIEWS, settings) is None
    assert check_outlines(scaled(1.01), VIEWS, settings) is None
    bare = [replace(view, mask=None) for view in VIEWS]
    assert check_outlines(scaled(2.0), bare, settings) is None


def test_a_tenth_of_wrong_masks_does_not_matter() -> None:
    wrong = [
        replace(view, mask=torch.full_like(view.mask, 255)) if row % 10 == 0 else view for row, view in enumerate(VIEWS)
    ]
    assert check_outlines(slab(), wrong, CaptureSettings()) is None


@pytest.mark.parametrize("surface", [scaled(1.1), scaled(0.9), Surface(slab().vertices + 0.02, slab().faces)])
def test_a_mesh_of_another_size_or_place_is_told(surface: Surface) -> None:
    warning = check_outlines(surface, VIEWS, CaptureSettings())
    assert warning.name == "surface"
    assert 0.05 < warning.value < 1.0


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_cameras_in_another_unit_are_refused_with_it(unit: str) -> None:
    """A mesh and contacts in meters, cameras in another unit that the settings do not name; and the other way round."""
    with raises(CaptureError, name="surface_unit", value=pytest.approx(1 / METRES[unit])) as caught:
        check_outlines(scaled(METRES[unit]), VIEWS, CaptureSettings())
    assert f'views_unit = "{unit}"' in str(caught.value)
    with raises(CaptureError, name="surface_unit", value=pytest.approx(METRES[unit])) as caught:
        check_outlines(scaled(1 / METRES[unit]), VIEWS, CaptureSettings())
    assert f'unit = "{unit}" and surface_unit = "{unit}"' in str(caught.value)


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_contacts_in_another_unit_than_the_cameras_are_refused_with_it(unit: str) -> None:
    contacts, settings = slab().vertices, CaptureSettings()
    expect_contacts_in_views(contacts, VIEWS, settings)
    expect_contacts_in_views(contacts / METRES[unit], [replace(view, mask=None) for view in VIEWS], settings)
    with raises(CaptureError, name="unit", value=pytest.approx(METRES[unit])) as caught:
        expect_contacts_in_views(contacts / METRES[unit], VIEWS, settings)
    assert f'unit = "{unit}"' in str(caught.value)


def test_reconstruct_refuses_them_before_it_fits_gaussians(tmp_path: Path, capsys: Streams) -> None:
    folder = fill_plate(tmp_path / "plate", surface=False)
    write_surface(slab(), folder / "surface.ply")
    write_views(slab_views(), tmp_path / "views")
    for part in (tmp_path / "views").iterdir():
        shutil.move(part, folder / part.name)
    with open(folder / "capture.toml", "a") as file:
        file.write('views_unit = "cm"\n')
    assert main(["fit", str(folder), "--gain-model", "visual", "--set", "lift.encoder=descriptors"]) == 2
    assert 'views_unit = "m"' in capsys.readouterr().err
    assert not (folder / ".avmsf" / "cloud.ply").exists()
