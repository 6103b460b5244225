"""The object's surface as an output of its own: alone, in three formats, and of a reconstruction."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf.cli import main
from avmsf.errors import EvaluationError
from avmsf.field.store import save
from avmsf.mesh import Surface, read_surface
from avmsf.photographs.folder import write_views
from avmsf.plotting.surfaces import draw_surface
from factories.believing_field import bar_contacts, drawn_gains, elastic_field, positional_field, sound_field
from factories.plate_capture import PLATE
from factories.small_scene import SMALL_SPLAT, THICKNESS, slab, slab_views, write_surface_file
from factories.verbs import results_of

Streams = pytest.CaptureFixture[str]


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_a_mesh_is_written_as_it_is_in_meters(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "slab"
    folder.mkdir()
    write_surface_file(folder)
    (folder / "capture.toml").write_text('surface_unit = "mm"')
    for option, name in (("--output", "a"), ("-o", "b")):
        assert main(["fit", str(folder), "--until", "surface", option, str(tmp_path / f"{name}.{kind}")]) == 0
    for name in "ab":
        written, given = read_surface(tmp_path / f"{name}.{kind}"), slab()
        assert torch.allclose(written.vertices, given.vertices / 1000, atol=1e-8)
        assert torch.equal(written.faces, given.faces)


def test_pictures_become_a_closed_surface_that_is_kept(tmp_path: Path) -> None:
    folder, output = tmp_path / "slab", tmp_path / "slab.ply"
    write_views(slab_views(), folder)
    assert main(["fit", str(folder), "--until", "surface", "--output", str(output), *SMALL_SPLAT]) == 0
    assert output.read_bytes() == (folder / ".avmsf" / "surface.ply").read_bytes()
    mesh = trimesh.load(output)
    assert mesh.is_watertight
    # A pixel of the pictures is 9 mm.
    assert mesh.extents.tolist() == pytest.approx([PLATE.length, PLATE.width, THICKNESS], abs=0.02)


def test_a_surface_is_drawn_with_two_cuts_through_its_middle(tmp_path: Path) -> None:
    whole, *cuts = draw_surface(slab(), title="slab").axes
    assert len(whole.collections[0].get_paths()) == len(slab().faces)
    # The slab's sides, in millimeters: each cut is a rectangle.
    a, b, c = (1000 * side for side in (PLATE.length, PLATE.width, THICKNESS))
    for axes, width in zip(cuts, (a, b), strict=True):
        ends = np.concatenate(axes.collections[0].get_segments())
        assert ends.min(axis=0) == pytest.approx([0, -c], abs=1e-3)
        assert ends.max(axis=0) == pytest.approx([width, 0], abs=1e-3)
    with pytest.raises(EvaluationError):
        draw_surface(Surface(slab().vertices, torch.zeros(0, 3, dtype=torch.int64)), title="points")


def test_contacts_are_drawn_in_the_view_and_near_each_cut() -> None:
    a, b = PLATE.length, PLATE.width
    contacts = torch.tensor([[0.1 * a, 0.5 * b, 0.0], [0.9 * a, 0.0, 0.0]], dtype=torch.float64)
    whole, across_y, across_x = draw_surface(slab(), title="slab", contacts=contacts).axes
    assert len(whole.lines[0].get_xdata()) == 2
    assert np.asarray(across_y.lines[0].get_xydata()) == pytest.approx(np.array([[100 * a, 0.0]]))
    assert len(across_x.lines[0].get_xdata()) == 0


def test_the_picture_is_written_beside_the_surface_and_with_a_field(tmp_path: Path, capsys: Streams) -> None:
    folder = tmp_path / "slab"
    folder.mkdir()
    write_surface_file(folder)
    values, _ = results_of(capsys, "fit", folder, "--until", "surface", "--plots", tmp_path)
    assert (values["kind"], values["triangles"]) == ("surface", len(slab().faces))
    assert (tmp_path / "surface.png").read_bytes().startswith(b"\x89PNG")
    contacts = bar_contacts(6)
    for name, made in (("with", elastic_field), ("without", positional_field)):
        save(sound_field(made(contacts, drawn_gains(contacts, seed=1))), tmp_path / f"{name}.safetensors")
        assert main(["info", str(tmp_path / f"{name}.safetensors"), "--plots", str(tmp_path / name)]) == 0
    assert (tmp_path / "with" / "surface.png").is_file()
    assert not (tmp_path / "without" / "surface.png").exists()
