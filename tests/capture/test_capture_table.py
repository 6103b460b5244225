"""`impacts.csv` and `capture.toml`: kind to spreadsheets, clear about everything else."""

import csv
import math
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh

from avmsf.capture import CaptureSettings, read_capture
from avmsf.capture.settings import METRES
from avmsf.capture.table import HOW_TO_WRITE, fitting_units
from avmsf.errors import CaptureError, CaptureWarning
from factories.capture_folder import HEADER, ROWS, fill
from factories.raising import raises, warns

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
        "sep=;\nfile;x;y;z\na.wav;0,1;0;0\nb.wav;0;0,2;0\nc.wav;0;0;0,3\n",
        "sep=,\n# a, b\nfile,x,y,z\na.wav,0.1,0,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
        "# bowl\n#\nfile,x,y,z\na.wav,0.1,\u22120,0\nb.wav,0,0.2,0\nc.wav,0,0,0.3\n",
        'z,y,x,file\n0,0,0.1,"a.wav"\n0,0.2,0,.\\b.wav\n0.3,0,0,./c.wav\n,,,\n',
    ],
    ids=[
        "bom and windows",
        "spaces, case",
        "semicolons",
        "tabs",
        "sep",
        "sep, comment",
        "comments, minus",
        "order, quotes, backslash, empty row",
    ],
)
def test_what_spreadsheets_write_is_read(tmp_path: Path, text: str) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_bytes(text.encode())
    impacts = read_capture(folder).impacts
    assert impacts.names == ("a.wav", "b.wav", "c.wav")
    assert torch.equal(impacts.contacts, CONTACTS)


def test_rows_keep_their_numbers_below_comments(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_text("# a bowl\n# in meters\nfile,x,y,z\na.wav,0.1,0,0\nb.wav,0,0.2,?\n")
    with raises(CaptureError, file="impacts.csv", row=5, name="z", value="?"):
        read_capture(folder)


def test_a_name_is_found_composed_or_decomposed(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "a.wav").rename(folder / "a\u0308.wav")
    text = (folder / "impacts.csv").read_text().replace("a.wav", "\u00e4.wav")
    (folder / "impacts.csv").write_text(text, encoding="utf-8")
    assert read_capture(folder).impacts.names[0] == "a\u0308.wav"


@pytest.mark.parametrize(
    ("content", "cause", "advice"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", type(None), "git lfs pull"),
        ("file,x,y,z\n\u00e4.wav,1,2,3\n".encode("utf-16"), UnicodeDecodeError, "UTF-8"),
        (b"file,x,y,z\n" + b"a" * 200_000 + b".wav,0,0,0\n", csv.Error, "cannot be read"),
    ],
    ids=["Git LFS", "UTF-16", "a cell without end"],
)
def test_what_is_no_table_says_so(tmp_path: Path, content: bytes, cause: type, advice: str) -> None:
    folder = fill(tmp_path)
    (folder / "impacts.csv").write_bytes(content)
    with raises(CaptureError, file="impacts.csv") as caught:
        read_capture(folder)
    assert isinstance(caught.value.__cause__, cause)
    assert advice in str(caught.value)


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
    ("header", "rows", "row", "name", "value"),
    [
        ("file,x,y", ("a.wav,0,0",), 1, "z", ["file", "x", "y"]),
        ("name,x,y", ("a.wav,0,0",), 1, "file", ["name", "x", "y"]),
        ("file,x,y,z,nx", ("a.wav,0,0,0,1",), None, "ny", ["nx"]),
        ("file,x,y,z,x", ("a.wav,0,0,0,1",), 1, "x", ["file", "x", "y", "z", "x"]),
        (HEADER, (), None, None, 0),
        ("", (), None, None, ""),
        (HEADER, ("a.wav,0.1,0", *ROWS[1:]), 2, "z", 3),
        (HEADER, (ROWS[0], "b.wav,0,nan,0", ROWS[2]), 3, "y", "nan"),
        (HEADER, (ROWS[0], "b.wav,0,left,0", ROWS[2]), 3, "y", "left"),
        (HEADER, (ROWS[0], "b.wav,0,,0", ROWS[2]), 3, "y", ""),
        (HEADER, (ROWS[0], ROWS[1], "c.wav,0,0,inf"), 4, "z", "inf"),
        (HEADER, (ROWS[0], "b.wav,0,200,0"), 3, "unit", [0.0, 200.0, 0.0]),
        (HEADER, (ROWS[0], "b.wav,0,-2e7,0"), 3, "unit", [0.0, -2e7, 0.0]),
        (HEADER, (ROWS[0], ",0,0.2,0"), 3, "file", ""),
        (HEADER, (ROWS[0], ".,0,0.2,0"), 3, "file", "."),
        (HEADER, (ROWS[0], "../b.wav,0,0.2,0"), 3, "file", "../b.wav"),
        (HEADER, (ROWS[0], "/b.wav,0,0.2,0"), 3, "file", "/b.wav"),
        (HEADER, (ROWS[0], "C:\\b.wav,0,0.2,0"), 3, "file", "C:\\b.wav"),
        (HEADER, (ROWS[0], ROWS[1], "a.wav,0,0,1"), 4, "file", "a.wav"),
        ("file,x,y,z,nx,ny,nz", ("a.wav,0,0,0,1,0,0", "b.wav,0,1,0,0,0,0"), 3, "nx", [0.0, 0.0, 0.0]),
        ("file,x,y,z,force_newtons", ("a.wav,0,0,0,2", "b.wav,0,1,0,0"), 3, "force_newtons", 0.0),
        ("file,x,y,z,force_newtons", ("a.wav,0,0,0,2", "b.wav,0,1,0,"), 3, "force_newtons", ""),
        # A force so small would lift the sound beyond float32.
        ("file,x,y,z,force_newtons", ("a.wav,0,0,0,2", "b.wav,0,1,0,1e-300"), 3, "force_newtons", 1e-300),
    ],
)
def test_a_bad_table_names_row_column_and_value(
    tmp_path: Path, header: str, rows: tuple[str, ...], row: int | None, name: str | None, value: Any
) -> None:
    with raises(CaptureError, file="impacts.csv", row=row, name=name, value=value):
        read_capture(fill(tmp_path, header=header, rows=rows))


@pytest.mark.parametrize(
    ("written", "fitting"),
    [(200.0, ["cm", "mm"]), (2.0, ["m", "cm", "in", "ft"]), (2e7, []), (22.4, ["cm", "mm", "in"])],
)
def test_units_that_fit_an_object_are_suggested(written: float, fitting: list[str]) -> None:
    advice = fitting_units(written)
    assert [unit for unit in METRES if f'"{unit}"' in advice] == fitting


def test_a_missing_folder_and_a_missing_table_are_distinguished(tmp_path: Path) -> None:
    with raises(CaptureError, file="nowhere"):
        read_capture(tmp_path / "nowhere")
    with raises(CaptureError, file=tmp_path / "impacts.csv") as caught:
        read_capture(tmp_path)
    assert HOW_TO_WRITE in str(caught.value)


@pytest.mark.parametrize(
    ("header", "rows", "row", "name", "value"),
    [
        ("file,x,y,z,who", tuple(f"{row},me" for row in ROWS), None, None, ["who"]),
        (HEADER, (*ROWS[:2], "c.wav,0,0.2,0"), 4, None, [[3, 4]]),
        (HEADER, ("a.wav,10,0,0", "b.wav,0,20,0", ROWS[2]), None, "unit", pytest.approx(math.hypot(10, 20, 0.3))),
        (HEADER, ("a.wav,0.0001,0,0", "b.wav,0,0.0002,0"), None, "unit", pytest.approx(math.hypot(1, 2) * 1e-4)),
    ],
)
def test_what_can_be_used_warns_and_is_read(
    tmp_path: Path, header: str, rows: tuple[str, ...], row: int | None, name: str | None, value: Any
) -> None:
    with warns(CaptureWarning, file="impacts.csv", row=row, name=name, value=value):
        capture = read_capture(fill(tmp_path, header=header, rows=rows))
    assert len(capture.impacts) == len(rows)


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        (HEADER, (*ROWS[:2], "c.wav,0,0.201,0")),
        (f"{HEADER},nx,ny,nz", ("a.wav,0.1,0,0,0,0,-1", "b.wav,0,0.2,0,0,0,-1", "c.wav,0,0.2,0,1,0,0")),
    ],
    ids=["close", "another direction"],
)
def test_what_is_no_repetition_is_read_in_silence(tmp_path: Path, header: str, rows: tuple[str, ...]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_capture(fill(tmp_path, header=header, rows=rows)).impacts) == 3


def test_contacts_far_outside_the_surface_are_refused(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=("a.wav,15,0,0", "b.wav,0,0.2,0"))
    trimesh.creation.box((0.5, 0.5, 0.5)).export(folder / "surface.ply")
    with raises(CaptureError, file="impacts.csv", row=2, name="surface", value=pytest.approx(14.75, abs=0.01)):
        read_capture(folder)


def test_a_surface_in_millimeters_beside_contacts_in_meters_is_refused_with_its_unit(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    trimesh.creation.box((200, 400, 600)).export(folder / "surface.ply")
    with raises(CaptureError, file="impacts.csv", name="unit") as caught:
        read_capture(folder)
    assert 'surface_unit = "mm"' in str(caught.value)
    (folder / "capture.toml").write_text('surface_unit = "mm"')
    surface = read_capture(folder).surface
    assert surface is not None
    assert surface.vertices.amax().item() == pytest.approx(0.3, rel=1e-6)


def test_a_name_that_no_file_can_have_is_reported(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=("a" * 300 + ".wav,0,0,0", "b.wav,0,0.2,0", "c.wav,0,0,0.3"))
    with raises(CaptureError, value="a" * 300 + ".wav"):
        read_capture(folder)


def read(folder: Path, text: str) -> CaptureSettings:
    (folder / "capture.toml").write_text(text)
    return CaptureSettings.read(folder / "capture.toml")


def test_every_key_is_optional_and_the_paper_keeps_three_seconds(tmp_path: Path) -> None:
    settings = read(tmp_path, "")
    assert settings == CaptureSettings()
    assert settings.kept_seconds(48000.0) == 3.0


def test_keys_are_read_and_whole_numbers_serve_as_numbers(tmp_path: Path) -> None:
    settings = read(tmp_path, 'unit = "mm"\nseconds = 2\nforce_channel = 1\nresponse_channel = 2\nalign = false\n')
    assert settings == CaptureSettings(unit="mm", seconds=2.0, force_channel=1, response_channel=2, align=False)
    assert settings.meters == 1e-3


@pytest.mark.parametrize(("unit", "meters"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("in", 0.0254), ("ft", 0.3048)])
def test_units_are_the_international_ones(unit: str, meters: float) -> None:
    assert CaptureSettings(unit=unit).meters == meters
    assert CaptureSettings(unit="m", surface_unit=unit).surface_meters == meters
    assert CaptureSettings(unit=unit).surface_meters == meters


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("second = 2.0", "second", "seconds"),
        ("color = 2.0", "color", None),
        ('seconds = "3"', "seconds", "3"),
        ("seconds = true", "seconds", True),
        ("response_channel = 1.5", "response_channel", 1.5),
        ("response_channel = true", "response_channel", True),
        ("align = 1", "align", 1),
        ("name = 3", "name", 3),
        ("seconds = 0", "seconds", 0.0),
        ("seconds = nan", "seconds", pytest.approx(math.nan, nan_ok=True)),
        ("playback_speed = -1", "playback_speed", -1.0),
        ("regularization = 0.0", "regularization", 0.0),
        ("force_scale = 0", "force_scale", 0.0),
        ('unit = "km"', "unit", "km"),
        ('surface_unit = "yd"', "surface_unit", "yd"),
        ("force_channel = 0", "force_channel", 0),
        ("force_channel = 2\nresponse_channel = 2", "force_channel", 2),
        ('normalize = "rms"', "normalize", "rms"),
        ('normalize = "deconvolve"', "force_channel", None),
        ('time_zero = "middle"', "time_zero", "middle"),
        ("highpass = -1.0", "highpass", -1.0),
        ("seconds = ", None, None),
        (f"seconds = {10**400}", "seconds", 10**400),
        ("a = " + "[" * 3000 + "]" * 3000, None, None),
    ],
    ids=lambda each: str(each)[:30],
)
def test_a_mistake_names_file_and_key(tmp_path: Path, text: str, name: str | None, value: Any) -> None:
    with raises(CaptureError, file="capture.toml", name=name, value=value):
        read(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with raises(CaptureError, file="nowhere.toml"):
        CaptureSettings.read(tmp_path / "nowhere.toml")


def test_slow_recordings_are_kept_for_as_many_samples() -> None:
    assert CaptureSettings().kept_seconds(44100.0) == 3.0
    assert CaptureSettings().kept_seconds(96000.0) == 3.0
    assert CaptureSettings().kept_seconds(400.0) * 400.0 == pytest.approx(3.0 * 44100.0)
    assert CaptureSettings(seconds=2.0).kept_seconds(400.0) == 2.0
