"""`impacts.csv` and `capture.toml`: kind to spreadsheets."""

from pathlib import Path

import pytest
import torch
import trimesh

from avmsf.capture import CaptureSettings, read_capture
from factories.capture_folder import ROWS, fill

CONTACTS = torch.tensor([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], dtype=torch.float64)


def test_rows_keep_their_order_and_contacts_are_meters(tmp_path: Path) -> None:
    capture = read_capture(fill(tmp_path / "bowl", rows=(ROWS[2], ROWS[0], ROWS[1])))
    assert capture.name == "bowl"
    assert capture.impacts.names == ("c.wav", "a.wav", "b.wav")
    assert torch.equal(capture.impacts.contacts, CONTACTS[[2, 0, 1]])
    assert capture.impacts.directions is None
    assert capture.impacts.forces is None
    assert capture.surface is None


SPREADSHEETS = {
    "bom and windows": "\ufefffile,x,y,z\r\na.wav,0.1,0,0\r\nb.wav,0,0.2,0\r\nc.wav,0,0,0.3\r\n",
    "spaces, case": " File , X,Y , z\n a.wav , 0.1, 0 ,0\n\nb.wav,0,0.2,0\nc.wav,0,0,0.3",
    "semicolons": "file;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
    "tabs": "file\tx\ty\tz\na.wav\t0.1\t0\t0\nb.wav\t0\t0.2\t0\nc.wav\t0\t0\t0.3\n",
    "sep": "sep=;\nfile;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
    "sep, comment": "sep=,\n# a, b\nfile,x,y,z\na.wav,0.1,0,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
    "comments, minus": "# bowl\n#\nfile,x,y,z\na.wav,0.1,\u22120,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
    "order, quotes, backslash, empty row": 'z,y,x,file\n0,0,0.1,"a.wav"\n0,0.2,0,.\\b.wav\n0.3,0,0,./c.wav\n,,,\n',
}


@pytest.mark.parametrize("text", SPREADSHEETS.values(), ids=SPREADSHEETS)
def test_what_spreadsheets_write_is_read(tmp_path: Path, text: str) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_bytes(text.encode())
    impacts = read_capture(folder).impacts
    assert impacts.names == ("a.wav", "b.wav", "c.wav")
    assert torch.equal(impacts.contacts, CONTACTS)


def test_a_name_is_found_composed_or_decomposed(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "a.wav").rename(folder / "a\u0308.wav")
    text = (folder / "impacts.csv").read_text().replace("a.wav", "\u00e4.wav")
    (folder / "impacts.csv").write_text(text, encoding="utf-8")
    assert read_capture(folder).impacts.names[0] == "a\u0308.wav"


@pytest.mark.parametrize("surface_unit", ["mm", "cm"])
def test_units_scale_contacts_and_surface(tmp_path: Path, surface_unit: str) -> None:
    size = {"mm": 100, "cm": 10}[surface_unit]
    folder = fill(
        tmp_path,
        rows=("a.wav,100,0,0", "b.wav,0,200,0", "c.wav,0,0,300"),
        settings=f'unit = "mm"\nname = "cup"\nsurface_unit = "{surface_unit}"',
    )
    trimesh.creation.box((2 * size, 4 * size, 6 * size)).export(folder / "surface.stl")
    capture = read_capture(folder)
    assert capture.name == "cup"
    # A few roundings in float64.
    assert torch.allclose(capture.impacts.contacts, CONTACTS, rtol=1e-15, atol=0)
    assert capture.surface.vertices.amax(0).tolist() == pytest.approx([0.1, 0.2, 0.3], rel=1e-6)


def test_directions_become_unit_vectors(tmp_path: Path) -> None:
    rows = ("a.wav,0.1,0,0,0,0,-2", "b.wav,0,0.2,0,3,0,4", "c.wav,0,0,0.3,1,0,0")
    directions = read_capture(fill(tmp_path, header="file,x,y,z,nx,ny,nz", rows=rows)).impacts.directions
    assert directions is not None
    assert torch.allclose(directions, torch.tensor([[0, 0, -1.0], [0.6, 0, 0.8], [1, 0, 0]]), rtol=1e-6, atol=0)


@pytest.mark.parametrize(("unit", "meters"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units_are_the_international_ones(unit: str, meters: float) -> None:
    assert CaptureSettings(unit=unit).meters == meters
    assert CaptureSettings(unit="m", surface_unit=unit).surface_meters == meters
    assert CaptureSettings(unit=unit).surface_meters == meters


def test_a_unit_is_open_only_where_none_is_stated_and_gives_an_object_of_usual_size():
    assert CaptureSettings().unit_ratios(8.0) == pytest.approx({"m": 1.0, "cm": 0.01, "in": 0.0254, "ft": 0.3048})
    assert CaptureSettings().unit_ratios(0.02) == {"m": 1.0}
    for stated in ({"unit": "cm"}, {"surface_unit": "m"}, {"views_unit": "mm"}):
        assert list(CaptureSettings(**stated).unit_ratios(8.0).values()) == [1.0]


def test_the_paper_s_three_seconds_are_kept_and_of_slow_recordings_as_many_samples() -> None:
    for settings, rate, seconds in (({}, 44100.0, 3.0), ({}, 96000.0, 3.0), ({"seconds": 2.0}, 400.0, 2.0)):
        assert CaptureSettings(**settings).kept_seconds(rate) == seconds
    assert CaptureSettings().kept_seconds(400.0) * 400.0 == pytest.approx(3.0 * 44100.0)
