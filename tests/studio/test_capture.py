"""Capture mode: what it writes is an ordinary capture folder, whole after every step, and nothing is written twice."""

import csv
import hashlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf._utils.processes import write_lock
from avmsf.capture import read_capture
from avmsf.capture.audio import MAX_SAMPLES
from avmsf.capture.table import Impact
from avmsf.errors import CaptureError, FolderInUseError, RecordingLengthError
from avmsf.pipeline.config import CACHE
from avmsf.studio.capture import CaptureEditor, read_contact
from avmsf.studio.responses import RequestError, response_to
from factories.capture_folder import fill, ring
from factories.raising import raises
from served import blow, wav


def contact(x: float) -> Impact:
    return read_contact({"x": repr(x), "y": "0.25", "z": "-0.001", "nx": "0", "ny": "0", "nz": "-2"})


def recorded(folder: Path, count: int) -> CaptureEditor:
    """Return the editor of a folder with so many impacts."""
    folder.mkdir(parents=True, exist_ok=True)
    editor = CaptureEditor(folder)
    for number in range(count):
        editor.add(blow(number), contact(0.1 * number))
    return editor


def table(folder: Path) -> list[list[str]]:
    with open(folder / "impacts.csv", newline="") as file:
        return list(csv.reader(file))


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def removed(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in (folder / CACHE / "removed").iterdir()]


def test_recorded_impacts_become_a_capture_that_reads_back(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 0)
    assert editor.describe()["strikes"] == []
    for number in range(3):
        added = editor.add(blow(number), contact(0.1 * number))
        assert (added["row"], added["file"]) == (number, f"{number + 1:03d}.wav")
        assert added["onset_seconds"] == pytest.approx(0.1, abs=1e-3)
        assert (added["clipped"], added["warnings"]) == (0, [])
    impacts = read_capture(tmp_path).impacts
    assert torch.equal(impacts.contacts[:, 0], torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64))
    assert impacts.directions is not None
    assert torch.equal(impacts.directions[1], torch.tensor([0.0, 0.0, -1.0]))
    assert (tmp_path / "002.wav").read_bytes() == blow(1)
    described = editor.describe()
    assert (described["ready"], described["problems"]) == (True, [])
    assert described["strikes"][2]["contact"] == (0.2, 0.25, -0.001)


def test_a_repeated_request_writes_nothing_twice(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 1)
    first = editor.add(blow(1), contact(0.1))
    before = contents(tmp_path)
    # A server that was started anew finds it too.
    for each in (editor, CaptureEditor(tmp_path)):
        assert each.add(blow(1), contact(0.1)) == first
    redone = editor.redo("001.wav", blow(7), match=hashlib.sha256(blow(0)).hexdigest())
    assert editor.redo("001.wav", blow(7), match=hashlib.sha256(blow(0)).hexdigest()) == redone
    assert contents(tmp_path).keys() - before.keys() == {next((tmp_path / CACHE / "removed").iterdir())}
    # Other files are compared as what is written of them.
    compressed = wav(ring(before=0.1, seed=5), subtype="PCM_16", kind="FLAC")
    assert editor.add(compressed, contact(0.3)) == editor.add(compressed, contact(0.3))
    assert editor.add(blow(1), contact(0.2))["file"] == "004.wav"


def test_what_fails_for_want_of_space_leaves_everything_as_it_was(tmp_path, monkeypatch):
    editor = recorded(tmp_path, 2)
    before = contents(tmp_path)
    replace = os.replace

    def fail(source: Path, path: Path) -> None:
        if path.name == "impacts.csv":
            raise OSError(28, os.strerror(28))
        replace(source, path)

    monkeypatch.setattr(os, "replace", fail)
    for change in (lambda: editor.add(blow(2), contact(0.2)), lambda: editor.remove("002.wav")):
        with pytest.raises(CaptureError):
            change()
        assert {path: content for path, content in contents(tmp_path).items() if path.parent == tmp_path} == {
            path: content for path, content in before.items() if path.parent == tmp_path
        }
    monkeypatch.undo()
    assert editor.add(blow(2), contact(0.2))["file"] == "003.wav"


def test_a_replaced_or_removed_recording_is_set_aside(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 2)
    rows = table(tmp_path)
    assert editor.redo("001.wav", blow(7))["row"] == 0
    assert (tmp_path / "001.wav").read_bytes() == blow(7)
    assert table(tmp_path) == rows
    assert removed(tmp_path) == [blow(0)]
    with pytest.raises(CaptureError):
        editor.redo("001.wav", b"hello")
    assert (tmp_path / "001.wav").read_bytes() == blow(7)
    for file in ("001.wav", "002.wav"):
        editor.remove(file)
        assert not (tmp_path / file).exists()
    assert sorted(removed(tmp_path)) == sorted([blow(0), blow(1), blow(7)])
    assert not (tmp_path / "impacts.csv").exists()
    assert editor.describe()["strikes"] == []


@pytest.mark.parametrize("file", ["004.wav", "../a.wav", "/etc/passwd", "capture.toml", "impacts.csv", ""])
def test_only_recordings_of_the_table_can_be_touched(tmp_path: Path, file: str) -> None:
    editor = CaptureEditor(fill(tmp_path / "filled", settings="seconds = 0.3"))
    (tmp_path / "a.wav").write_bytes(blow())
    for act in (lambda: editor.remove(file), lambda: editor.redo(file, blow())):
        with raises(RequestError, file="impacts.csv", value=file) as refused:
            act()
        assert refused.value.status == 404
    assert (tmp_path / "a.wav").read_bytes() == blow()


def test_a_link_is_never_written_through_and_one_out_of_the_folder_not_read(tmp_path: Path) -> None:
    folder, outside = fill(tmp_path / "filled"), tmp_path / "outside.wav"
    # A recording of another rate, which does not count either.
    outside.write_bytes(wav(ring(rate=16000), rate=16000))
    (folder / "out.wav").symlink_to(outside)
    (folder / "inner.wav").symlink_to("a.wav")
    (folder / "sub").symlink_to(".")
    rows = "".join(f"{file},0,{row},0\n" for row, file in enumerate(("a.wav", "out.wav", "inner.wav", "sub/b.wav")))
    (folder / "impacts.csv").write_text(f"file,x,y,z\n{rows}")
    editor = CaptureEditor(folder)
    assert [impact["readable"] for impact in editor.describe()["strikes"]] == [True, False, True, True]
    assert editor.check(blow())["sample_rate"] == 8000
    before = contents(tmp_path)
    for file in ("out.wav", "inner.wav", "sub/b.wav"):
        changes: list[Callable[[], object]] = [lambda: editor.redo(file, blow(9)), lambda: editor.remove(file)]  # noqa: B023
        for change in changes:
            with raises(RequestError, file=file, value="link") as refused:
                change()
            assert refused.value.status == 409
    after = contents(tmp_path)
    assert {path: after[path] for path in before} == before


def test_another_tabs_recording_is_neither_overwritten_nor_removed(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 1)
    [added] = editor.describe()["strikes"]
    assert added["digest"] == hashlib.sha256(blow(0)).hexdigest()
    redone = editor.redo("001.wav", blow(2), match=added["digest"])
    assert editor.describe()["strikes"][0]["digest"] == redone["digest"] != added["digest"]
    for change in (
        lambda: editor.redo("001.wav", blow(3), match=added["digest"]),
        lambda: editor.remove("001.wav", match=added["digest"]),
    ):
        with raises(RequestError, file="001.wav", value=added["digest"]) as refused:
            change()
        assert refused.value.status == 409
    assert (tmp_path / "001.wav").read_bytes() == blow(2)
    editor.remove("001.wav", match=redone["digest"])
    assert not (tmp_path / "impacts.csv").exists()


WINDOWS = '\ufeff# by Ann\r\nName;file;z;x;y\r\nfirst;a.wav;0;0,1;0\r\n"second; 2";b.wav;0;0;20\r\nc;c.wav;30;0;0\r\n'
UNIX = 'file, x,y,z,note\na.wav,0, 0,0,\n\nb.wav,0,0,20,"two\nlines"\nc.wav,30,0,0,  plain'


@pytest.mark.parametrize(
    ("text", "row", "without"),
    [
        # With decimal commas, as those before it, and in no more digits than it takes.
        (WINDOWS, ";001.wav;30,0;11,0;2,0\r\n", '"second; 2";b.wav;0;0;20\r\n'),
        (UNIX, "\n001.wav,11.0,2.0,30.0,\n", '\nb.wav,0,0,20,"two\nlines"\n'),
    ],
)
def test_a_table_of_the_users_own_stays_to_the_last_byte_but_for_what_changes(tmp_path, text, row, without):
    folder = fill(tmp_path / "filled", settings='unit = "cm"')
    (folder / "impacts.csv").write_bytes(text.encode())
    editor = CaptureEditor(folder)
    added = editor.add(blow(3), read_contact({"x": "0.11", "y": "0.02", "z": "0.3"}))
    assert added["contact"] == pytest.approx((0.11, 0.02, 0.3), abs=1e-15)
    assert (folder / "impacts.csv").read_bytes().decode() == text + row
    editor.remove("b.wav")
    assert (folder / "impacts.csv").read_bytes().decode() == text.replace(without, "") + row


def test_every_row_has_what_the_table_has_columns_for(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 1)
    # An unknown direction is zero.
    assert editor.add(blow(), read_contact({"x": "0.2", "y": "0", "z": "0"}))["direction"] == (0.0, 0.0, 0.0)
    (tmp_path / "impacts.csv").write_text("file,x,y,z,force_newtons\n001.wav,0,0,0,12.5\n")
    with raises(RequestError, file=tmp_path / "impacts.csv", name="force"):
        editor.add(blow(1), contact(0.2))


@pytest.mark.parametrize(
    ("query", "name", "value"),
    [
        ({}, "x", ""),
        ({"x": "=HYPERLINK()", "y": "0", "z": "0"}, "x", "=HYPERLINK()"),
        ({"x": "1e9", "y": "0", "z": "0"}, "unit", [1e9, 0.0, 0.0]),
        ({"x": "0", "y": "0", "z": "0", "nx": "1"}, "ny", ""),
    ],
)
def test_contacts_are_numbers_and_nothing_else(query: dict[str, str], name: str, value: object) -> None:
    with raises(RequestError, name=name, value=value) as refused:
        read_contact(query)
    assert refused.value.status == 400
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize(
    "content", [b"", b"<html>", wav(np.zeros(4000)), blow()[:60]], ids=["empty", "page", "silent", "truncated"]
)
def test_a_recording_that_cannot_be_used_is_refused(tmp_path: Path, content: bytes) -> None:
    editor = recorded(tmp_path, 0)
    for act in (lambda: editor.check(content), lambda: editor.add(content, contact(0.1))):
        with pytest.raises(CaptureError):
            act()
    assert [path.name for path in contents(tmp_path)] == ["capture.lock"]


def test_a_recording_that_is_long_beyond_use_is_refused(tmp_path: Path) -> None:
    """Half an hour of silence, compressed to a few kilobytes."""
    content = wav(np.zeros(MAX_SAMPLES + 1, dtype=np.float32), subtype="PCM_16", kind="FLAC")
    with pytest.raises(RecordingLengthError) as refused:
        recorded(tmp_path, 0).add(content, contact(0.1))
    assert response_to(refused.value).status_code == 413


def test_another_rate_is_refused_at_once(tmp_path: Path) -> None:
    editor = recorded(tmp_path, 1)
    with raises(CaptureError, name="sample_rate", value=16000.0):
        editor.check(wav(ring(rate=16000), rate=16000))
    # Where it is the only one it may change.
    assert editor.redo("001.wav", wav(ring(rate=16000), rate=16000))["sample_rate"] == 16000


def test_a_recording_of_another_format_becomes_a_wav_of_the_same_samples(tmp_path: Path) -> None:
    sound = np.round(ring(before=0.1) * 32768) / 32768
    flac = wav(sound, subtype="PCM_16", kind="FLAC")
    for name, content in (("hit.flac", flac), ("hit2.flac", flac), ("hit2.wav", blow(4))):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "impacts.csv").write_text("file,x,y,z,note\nhit.flac,0,0,0,a  b\nhit2.flac,0.1,0,0,\n")
    editor = CaptureEditor(tmp_path)
    added = editor.add(flac, contact(0.3))["file"]
    samples, rate = soundfile.read(tmp_path / added)
    assert (added, rate, (tmp_path / added).read_bytes()[:4]) == ("001.wav", 8000, b"RIFF")
    assert np.array_equal(samples, sound)
    # Redone, it is a wav of its own name, unless there is another one.
    redone = editor.redo("hit.flac", blow(6))
    assert (redone["file"], redone["row"], redone["readable"]) == ("hit.wav", 0, True)
    assert (tmp_path / "hit.wav").read_bytes() == blow(6)
    assert not (tmp_path / "hit.flac").exists()
    assert removed(tmp_path) == [flac]
    assert editor.redo("hit2.flac", blow(7))["file"] == "002.wav"
    assert (tmp_path / "hit2.wav").read_bytes() == blow(4)
    assert (tmp_path / "impacts.csv").read_text().splitlines()[1] == "hit.wav,0,0,0,a  b"


@pytest.mark.parametrize(
    ("text", "kind", "attributes"),
    [
        ("file,x,y,z\na.wav,1,2\n", CaptureError, {}),
        ("file,x,y\n", CaptureError, {}),
        ("file,x,y,z\na.wav,0,0,0\na.wav,1,0,0\n", RequestError, {"name": "a.wav", "value": [2, 3]}),
    ],
)
def test_a_broken_table_and_a_recording_of_two_rows_are_left_alone(tmp_path, text, kind, attributes):
    folder = fill(tmp_path / "filled")
    (folder / "impacts.csv").write_text(text)
    editor, before = CaptureEditor(folder), contents(folder)
    for act in (lambda: editor.redo("a.wav", blow(5)), lambda: editor.remove("a.wav")):
        with raises(kind, file="impacts.csv", **attributes):
            act()
    assert before.items() <= contents(folder).items()


def test_impacts_of_two_studios_at_once_are_all_there(tmp_path: Path) -> None:
    added: dict[str, bytes] = {}
    together = threading.Barrier(2)

    def record(studio: int) -> None:
        editor = CaptureEditor(tmp_path)
        for number in range(studio, 8, 2):
            together.wait(20)
            added[editor.add(blow(number), contact(0.1))["file"]] = blow(number)

    with ThreadPoolExecutor(2) as studios:
        list(studios.map(record, range(2)))
    names = [f"{number:03d}.wav" for number in range(1, 9)]
    assert [row[0] for row in table(tmp_path)] == ["file", *names]
    assert sorted(added) == names
    assert {name: (tmp_path / name).read_bytes() for name in names} == added


def test_a_change_waits_for_another_studios_and_then_changes_nothing(tmp_path: Path) -> None:
    def change() -> None:
        CaptureEditor(tmp_path, lock_seconds=0.1).add(blow(0), contact(0.1))

    with (
        ThreadPoolExecutor(1) as other,
        write_lock(tmp_path / CACHE, "capture", command="avmsf studio"),
        pytest.raises(FolderInUseError) as refused,
    ):
        other.submit(change).result(20)
    assert response_to(refused.value).status_code == 503
    assert not (tmp_path / "impacts.csv").exists()
    # Stages that are made meanwhile do not keep impacts out.
    with ThreadPoolExecutor(1) as other, write_lock(tmp_path / CACHE, "stages", command="avmsf fit"):
        other.submit(change).result(20)
    assert (tmp_path / "001.wav").read_bytes() == blow(0)
