"""`impacts.csv` and the contacts in it: kind to spreadsheets, clear about everything else."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.capture import CaptureWarning, read_capture
from avmsf.errors import CaptureError
from capture_folder import HEADER, ROWS, fill

CONTACTS = torch.tensor([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]], dtype=torch.float64)


def test_rows_keep_their_order_and_contacts_are_meters(tmp_path: Path) -> None:
    capture = read_capture(fill(tmp_path / "bowl", rows=(ROWS[2], ROWS[0], ROWS[1])))
    assert capture.name == "bowl"
    assert capture.impacts.names == ("c.wav", "a.wav", "b.wav")
    assert torch.equal(capture.impacts.contacts, CONTACTS[[2, 0, 1]])
    assert capture.impacts.directions is None
    assert capture.impacts.forces is None
    assert capture.surface is None


@pytest.mark.parametrize(
    "text",
    [
        "\ufefffile,x,y,z\r\na.wav,0.1,0,0\r\nb.wav,0,0.2,0\r\nc.wav,0,0,0.3\r\n",
        " File , X,Y , z\n a.wav , 0.1, 0 ,0\n\nb.wav,0,0.2,0\nc.wav,0,0,0.3",
        "file;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
        "file\tx\ty\tz\na.wav\t0.1\t0\t0\nb.wav\t0\t0.2\t0\nc.wav\t0\t0\t0.3\n",
        'z,y,x,file\n0,0,0.1,"a.wav"\n0,0.2,0,.\\b.wav\n0.3,0,0,./c.wav\n,,,\n',
    ],
    ids=["bom and windows", "spaces and case", "semicolons", "tabs", "order, quotes, backslash, empty row"],
)
def test_what_spreadsheets_write_is_read(tmp_path: Path, text: str) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_bytes(text.encode())
    impacts = read_capture(folder).impacts
    assert impacts.names == ("a.wav", "b.wav", "c.wav")
    assert torch.equal(impacts.contacts, CONTACTS)


def test_units_scale_contacts_and_surface_alike(tmp_path: Path) -> None:
    folder = fill(
        tmp_path, rows=("a.wav,100,0,0", "b.wav,0,200,0", "c.wav,0,0,300"), settings='unit = "mm"\nname = "cup"'
    )
    trimesh.creation.box((200, 400, 600)).export(folder / "surface.stl")
    capture = read_capture(folder)
    assert capture.name == "cup"
    # A few roundings in float64.
    assert torch.allclose(capture.impacts.contacts, CONTACTS, rtol=1e-15, atol=0)
    assert capture.surface is not None
    assert capture.surface.vertices.abs().max() == pytest.approx(0.3, rel=1e-6)


def test_directions_become_unit_vectors(tmp_path: Path) -> None:
    rows = ("a.wav,0.1,0,0,0,0,-2", "b.wav,0,0.2,0,3,0,4", "c.wav,0,0,0.3,1,0,0")
    directions = read_capture(fill(tmp_path, header="file,x,y,z,nx,ny,nz", rows=rows)).impacts.directions
    assert directions is not None
    assert torch.allclose(directions, torch.tensor([[0, 0, -1.0], [0.6, 0, 0.8], [1, 0, 0]]), rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("file,x,y", ("a.wav,0,0",), "column z is missing, found file, x, y; .*header line file,x,y,z"),
        ("name,x,y", ("a.wav,0,0",), "columns file, z are missing"),
        ("file,x,y,z,nx", ("a.wav,0,0,0,1",), "needs all of nx, ny, nz; found only nx"),
        ("file,x,y,z,x", ("a.wav,0,0,0,1",), "more than one column is called x"),
        (HEADER, (), "a header and no row"),
        ("", (), "the table is empty"),
        (HEADER, ("a.wav,0.1,0", *ROWS[1:]), "line 2: 3 cells where the header has 4"),
        (HEADER, (ROWS[0], "b.wav,0,nan,0", ROWS[2]), "line 3: y is 'nan'; expected a number"),
        (HEADER, (ROWS[0], "b.wav,0,left,0", ROWS[2]), "line 3: y is 'left'; expected a number"),
        (HEADER, (ROWS[0], "b.wav,0,,0", ROWS[2]), "line 3: y is ''; expected a number"),
        (HEADER, (ROWS[0], ROWS[1], "c.wav,0,0,inf"), "line 4: z is 'inf'"),
        (HEADER, (ROWS[0], "b.wav,0,200,0"), r'line 3: .* 200 m away .*unit = "mm" \(0.2 m\)'),
        (HEADER, (ROWS[0], "b.wav,0,-2e7,0"), "line 3: .* 2e.07 m away .*no unit would make"),
        (HEADER, (ROWS[0], ",0,0.2,0"), "line 3: file is empty"),
        (HEADER, (ROWS[0], "../b.wav,0,0.2,0"), "line 3: ../b.wav lies outside the capture folder"),
        (HEADER, (ROWS[0], "/b.wav,0,0.2,0"), "line 3: /b.wav lies outside"),
        (HEADER, (ROWS[0], "C:\\b.wav,0,0.2,0"), "line 3: .* lies outside"),
        (HEADER, (ROWS[0], ROWS[1], "a.wav,0,0,1"), "line 4: a.wav stands in line 2 already"),
        ("file,x,y,z,nx,ny,nz", ("a.wav,0,0,0,1,0,0", "b.wav,0,1,0,0,0,0"), "line 3: nx,ny,nz is the zero vector"),
        ("file,x,y,z,force_newtons", ("a.wav,0,0,0,2", "b.wav,0,1,0,0"), "line 3: force_newtons is 0"),
        ("file,x,y,z,force_newtons", ("a.wav,0,0,0,2", "b.wav,0,1,0,"), "line 3: force_newtons is ''"),
    ],
)
def test_a_bad_table_names_line_value_and_cure(
    tmp_path: Path, header: str, rows: tuple[str, ...], message: str
) -> None:
    with pytest.raises(CaptureError, match=message):
        read_capture(fill(tmp_path, header=header, rows=rows))


def test_missing_folder_table_and_encoding_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="there is no such folder"):
        read_capture(tmp_path / "nowhere")
    folder = fill(tmp_path / "bowl")
    (folder / "impacts.csv").write_bytes("file,x,y,z\nä.wav,1,2,3\n".encode("utf-16"))
    with pytest.raises(CaptureError, match="CSV UTF-8"):
        read_capture(folder)
    (folder / "impacts.csv").unlink()
    with pytest.raises(
        CaptureError, match=r"no impacts\.csv in this folder; .* header line file,x,y,z .*001\.wav,0\.12"
    ):
        read_capture(folder)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("file,x,y,z,who", tuple(f"{row},me" for row in ROWS), "columns that are not used: who"),
        (HEADER, (*ROWS[:2], "c.wav,0,0.2,0"), "one and the same contact: 3, 4; kept as repeated blows"),
        (HEADER, ("a.wav,10,0,0", "b.wav,0,20,0", ROWS[2]), r'22.4 m apart .*unit = "cm" \(0.224 m\)'),
        (HEADER, ("a.wav,0.0001,0,0", "b.wav,0,0.0002,0"), r"all contacts lie within 0.22 mm"),
    ],
)
def test_what_can_be_used_warns_and_is_read(tmp_path: Path, header: str, rows: tuple[str, ...], message: str) -> None:
    with pytest.warns(CaptureWarning, match=message):
        capture = read_capture(fill(tmp_path, header=header, rows=rows))
    assert len(capture.impacts) == len(rows)


def test_two_blows_at_one_place_are_not_confused_with_two_close_ones(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=(*ROWS[:2], "c.wav,0,0.201,0"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_capture(folder).impacts) == 3


def test_impacts_at_one_place_along_different_directions_are_no_repetitions(tmp_path: Path) -> None:
    rows = ("a.wav,0.1,0,0,0,0,-1", "b.wav,0,0.2,0,0,0,-1", "c.wav,0,0.2,0,1,0,0")
    folder = fill(tmp_path, header=f"{HEADER},nx,ny,nz", rows=rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_capture(folder).impacts) == 3


def test_contacts_far_outside_the_surface_are_refused(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=("a.wav,15,0,0", "b.wav,0,0.2,0"))
    trimesh.creation.box((0.5, 0.5, 0.5)).export(folder / "surface.ply")
    with pytest.raises(CaptureError, match=r"line 2: the contact lies 14.8 m off the surface, .* 0.866 m across"):
        read_capture(folder)


def test_a_surface_in_millimeters_beside_contacts_in_meters_is_refused_with_its_unit(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    trimesh.creation.box((200, 400, 600)).export(folder / "surface.ply")
    with pytest.raises(CaptureError, match=r'is the surface.s unit mm\? If so, write surface_unit = "mm"'):
        read_capture(folder)
    (folder / "capture.toml").write_text('surface_unit = "mm"')
    surface = read_capture(folder).surface
    assert surface is not None
    assert surface.vertices.amax().item() == pytest.approx(0.3, rel=1e-6)


def test_what_is_no_table_says_so(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_text("file,x,y,z\n" + "a" * 200_000 + ".wav,0,0,0\n")
    with pytest.raises(CaptureError, match=r"impacts\.csv: not a table that can be read: field larger"):
        read_capture(folder)


def test_a_name_that_no_file_can_have_is_reported(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=("a" * 300 + ".wav,0,0,0", "b.wav,0,0.2,0", "c.wav,0,0,0.3"))
    with pytest.raises(CaptureError, match=r"a…: no file can be called that"):
        read_capture(folder)


def test_a_clip_too_short_for_the_highpass_is_too_short(tmp_path: Path) -> None:
    folder = fill(tmp_path, settings="highpass = 20.0")
    soundfile.write(folder / "a.wav", np.linspace(-0.1, 0.1, 12), 48_000)
    with pytest.raises(CaptureError, match=r"a\.wav: too short, 12 samples"):
        read_capture(folder)
