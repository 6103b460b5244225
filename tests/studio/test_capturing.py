"""Capture mode: what it writes is an ordinary capture folder, whole after every step, and nothing is written twice."""

import csv
import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from avmsf.capture import check, read_capture
from avmsf.errors import CaptureError
from avmsf.studio import judgements
from avmsf.studio import strike_files as strikefiles
from avmsf.studio.capturing import StrikeBook
from avmsf.studio.place import Place
from avmsf.studio.refusal import RefusedError
from avmsf.studio.strike_files import StrikeFiles
from avmsf.studio.strike_table import StrikeTable
from factories.capture_folder import fill, ring
from factories.raising import raises
from opened_plate import blow, wav

DOWN = (0.0, 0.0, -2.0)


def key(number: int) -> str:
    return f"strike-{number:04d}"


def book(folder: Path) -> StrikeBook:
    folder.mkdir(parents=True, exist_ok=True)
    return StrikeBook(folder)


def place(x: float, *, direction: tuple[float, float, float] | None = DOWN) -> Place:
    return Place((x, 0.25, -1e-3), direction)


def table(folder: Path) -> list[list[str]]:
    with open(folder / "impacts.csv", newline="") as file:
        return list(csv.reader(file))


def test_strikes_become_a_capture_that_reads_back(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    assert strikes.describe()["strikes"] == []
    for number in range(3):
        added = strikes.add(blow(number), place(0.1 * number), key=key(number))
        assert (added["row"], added["file"]) == (number, f"{number + 1:03d}.wav")
        assert added["onset_seconds"] == pytest.approx(0.1, abs=1e-3)
        assert (added["clipped"], added["warnings"]) == (0, [])
    capture = read_capture(tmp_path)
    assert torch.equal(capture.impacts.contacts[:, 0], torch.tensor([0.0, 0.1, 0.2], dtype=torch.float64))
    assert capture.impacts.directions is not None
    assert torch.equal(capture.impacts.directions[1], torch.tensor([0.0, 0.0, -1.0]))
    assert (tmp_path / "002.wav").read_bytes() == blow(1)
    told = strikes.describe()
    assert told["ready"]
    assert told["problems"] == []
    assert told["strikes"][2]["contact"] == (0.2, 0.25, -0.001)


def test_the_judgement_is_that_of_check(tmp_path: Path) -> None:
    clipped = np.clip(6 * ring(before=0.1), -1.0, 1.0)
    recordings = {"a.wav": ring(before=0.1), "b.wav": clipped, "c.wav": ring(noise=0.2, before=0.1)}
    folder = fill(tmp_path / "filled", replace=recordings)
    told = book(folder).describe()["strikes"]
    for found, expected in zip(told, check(folder).recordings, strict=True):
        assert found["warnings"] == list(expected.problems)
        assert found["peak_db"] == expected.peak_db
        judged = book(folder).judge((folder / expected.file).read_bytes())
        for name in ("readable", "seconds", "sample_rate", "peak_db", "clipped", "onset_seconds"):
            assert judged[name] == found[name]
    assert told[1]["clipped"] > 10
    assert "turn the gain down" in told[1]["warnings"][0]


def test_judging_writes_nothing(tmp_path: Path) -> None:
    book(tmp_path).judge(blow())
    assert list(tmp_path.iterdir()) == []


def test_a_retry_writes_nothing_twice(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    first = strikes.add(blow(), place(0.1), key=key(0))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert strikes.add(blow(), place(0.1), key=key(0)) == first
    # A server that was started anew knows it as well.
    assert StrikeBook(tmp_path).add(blow(), place(0.1), key=key(0)) == first
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert strikes.add(blow(), place(0.1), key=key(1))["file"] == "002.wav"


@pytest.mark.parametrize("broken", [(StrikeFiles, "write"), (StrikeTable, "add")])
def test_what_broke_off_is_finished_by_the_retry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: tuple[type, str]
) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(1), place(0.3), key=key(1))

    def fail(*arguments: object) -> None:
        raise OSError("the power went")

    with monkeypatch.context() as patched:
        patched.setattr(*broken, fail)
        with pytest.raises(OSError) as caught:
            strikes.add(blow(), place(0.1), key=key(0))
        assert caught.value.args == ("the power went",)
    assert len(table(tmp_path)) == 2
    again = StrikeBook(tmp_path).add(blow(), place(0.1), key=key(0))
    assert again["file"] == "002.wav"
    assert [row[0] for row in table(tmp_path)] == ["file", "001.wav", "002.wav"]
    assert sorted(path.name for path in tmp_path.glob("*.wav")) == ["001.wav", "002.wav"]


def test_one_key_is_one_strike(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(), place(0.1), key=key(0))
    for content, where in ((blow(1), place(0.1)), (blow(), place(0.2))):
        with raises(RefusedError, name="Idempotency-Key", value=key(0)) as refused:
            strikes.add(content, where, key=key(0))
        assert refused.value.status == 409
    for bad in ("", "short", "x" * 200, "with spaces and\n"):
        with raises(RefusedError, name="Idempotency-Key", value=bad) as refused:
            strikes.add(blow(), place(0.1), key=bad)
        assert refused.value.status == 400
    assert len(table(tmp_path)) == 2


def test_redoing_keeps_the_row_and_the_recording_before(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    for number in range(2):
        strikes.add(blow(number), place(0.1 * number), key=key(number))
    rows = table(tmp_path)
    redone = strikes.redo("001.wav", blow(7))
    assert redone["row"] == 0
    assert (tmp_path / "001.wav").read_bytes() == blow(7)
    assert table(tmp_path) == rows
    [kept] = (tmp_path / ".avmsf" / "removed").iterdir()
    assert kept.read_bytes() == blow(0)
    with pytest.raises(CaptureError):
        strikes.redo("001.wav", b"hello")
    assert (tmp_path / "001.wav").read_bytes() == blow(7)


def test_what_is_taken_out_is_kept_aside_and_its_number_not_given_again(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    for number in range(3):
        strikes.add(blow(number), place(0.1 * number), key=key(number))
    strikes.remove("003.wav")
    assert [row[0] for row in table(tmp_path)[1:]] == ["001.wav", "002.wav"]
    assert not (tmp_path / "003.wav").exists()
    [kept] = (tmp_path / ".avmsf" / "removed").iterdir()
    assert kept.read_bytes() == blow(2)
    with raises(RefusedError, file="003.wav"):
        strikes.add(blow(2), place(0.2), key=key(2))
    strikes.remove("001.wav")
    with raises(RefusedError, file="003.wav"):
        strikes.add(blow(2), place(0.2), key=key(2))
    assert strikes.add(blow(3), place(0.3), key=key(3))["file"] == "004.wav"
    for file in ("002.wav", "004.wav"):
        strikes.remove(file)
    assert not (tmp_path / "impacts.csv").exists()
    assert strikes.describe()["strikes"] == []


@pytest.mark.parametrize("file", ["004.wav", "../a.wav", "/etc/passwd", "capture.toml", "impacts.csv", ""])
def test_only_recordings_of_the_table_can_be_touched(tmp_path: Path, file: str) -> None:
    folder = fill(tmp_path / "filled", settings="seconds = 0.3")
    (tmp_path / "a.wav").write_bytes(blow())
    for act in (lambda: book(folder).remove(file), lambda: book(folder).redo(file, blow())):
        with raises(RefusedError, file="impacts.csv", value=file) as refused:
            act()
        assert refused.value.status == 404
    assert (tmp_path / "a.wav").read_bytes() == blow()


def test_a_link_out_of_the_folder_is_neither_read_nor_written(tmp_path: Path) -> None:
    folder = fill(tmp_path / "filled")
    outside = tmp_path / "outside.wav"
    outside.write_bytes(blow(5))
    (folder / "a.wav").unlink()
    (folder / "a.wav").symlink_to(outside)
    strikes = book(folder)
    told = strikes.describe()["strikes"][0]
    assert not told["readable"]
    assert told["warnings"][0].startswith("a.wav: ")
    assert [strike.file for strike in strikes.strikes()] == ["b.wav", "c.wav"]
    for change in (lambda: strikes.redo("a.wav", blow()), lambda: strikes.remove("a.wav")):
        before = (folder / "impacts.csv").read_bytes()
        with raises(RefusedError, file="a.wav", value="link"):
            change()
        assert (folder / "impacts.csv").read_bytes() == before
    assert [each.name for each in (folder / ".avmsf").iterdir()] == ["capture.lock"]
    # Its rate is another's matter too.
    outside.write_bytes(wav(ring(rate=16000), rate=16000))
    for name in ("b.wav", "c.wav"):
        (folder / name).unlink()
    assert strikes.judge(blow())["sample_rate"] == 8000
    outside.write_bytes(blow(5))
    assert outside.read_bytes() == blow(5)


def test_a_table_of_the_users_own_keeps_its_unit_columns_and_order(tmp_path: Path) -> None:
    header, rows = "Name;file;z;x;y", ("first;a.wav;0;0,1;0", "second;b.wav;0;0;20", "third;c.wav;30;0;0")
    folder = fill(tmp_path / "filled", header=header, rows=rows, settings='unit = "cm"')
    added = book(folder).add(blow(3), Place((0.11, 0.02, 0.3)), key=key(0))
    assert added["contact"] == pytest.approx((0.11, 0.02, 0.3), abs=1e-15)
    text = (folder / "impacts.csv").read_text().splitlines()
    assert text[1] == "first;a.wav;0;0,1;0"
    assert text[4].split(";")[:2] == ["", "001.wav"]
    assert text[0] == header
    # With decimal commas, as those before it, and in no more digits than it takes.
    assert text[4].split(";")[2:] == ["30,0", "11,0", "2,0"]


def test_every_row_has_what_the_table_has_columns_for(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(), place(0.1), key=key(0))
    with raises(RefusedError, file=tmp_path / "impacts.csv", name="direction"):
        strikes.add(blow(), place(0.2, direction=None), key=key(1))
    forced = book(tmp_path / "forced")
    forced.add(blow(), Place((0.1, 0.0, 0.0), None, 12.5), key=key(0))
    with raises(RefusedError, file=tmp_path / "forced" / "impacts.csv", name="force"):
        forced.add(blow(), place(0.2, direction=None), key=key(1))
    assert table(tmp_path / "forced")[1] == ["001.wav", "0.1", "0.0", "0.0", "12.5"]


@pytest.mark.parametrize(
    ("query", "name", "value"),
    [
        ({}, "contact", None),
        ({"x": "1", "y": "2"}, "z", None),
        ({"x": "=HYPERLINK()", "y": "0", "z": "0"}, "x", "=HYPERLINK()"),
        ({"x": "nan", "y": "0", "z": "0"}, "x", "nan"),
        ({"x": "1e9", "y": "0", "z": "0"}, "contact", (1e9, 0.0, 0.0)),
        ({"x": "0", "y": "0", "z": "0", "nx": "1"}, "ny", None),
        ({"x": "0", "y": "0", "z": "0", "nx": "0", "ny": "0", "nz": "0"}, "direction", (0.0, 0.0, 0.0)),
        ({"x": "0", "y": "0", "z": "0", "newtons": "-3"}, "newtons", -3.0),
    ],
)
def test_places_are_numbers_and_nothing_else(query: dict[str, str], name: str, value: object) -> None:
    with raises(RefusedError, name=name, value=value) as refused:
        Place.read(query)
    assert refused.value.status == 400


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"RIFF\x00\x00\x00\x00WAVE",
        b"<html>",
        wav(np.zeros(4000)),
        wav(ring(0.01)),
        wav(np.full(4000, np.nan)),
        wav(np.stack([ring(seed=0), ring(seed=1)], axis=1)),
        blow()[:60],
    ],
    ids=["empty", "header", "page", "silent", "short", "NaN", "channels", "truncated"],
)
def test_a_recording_that_cannot_be_used_is_refused(tmp_path: Path, content: bytes) -> None:
    strikes = book(tmp_path)
    for act in (lambda: strikes.judge(content), lambda: strikes.add(content, place(0.1), key=key(0))):
        with pytest.raises(CaptureError):
            act()
    assert [each.name for each in tmp_path.rglob("*") if each.is_file()] == ["capture.lock"]


def test_a_strike_whose_removal_was_killed_is_there_for_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strikes = book(tmp_path)
    added = strikes.add(blow(), place(0.1), key=key(0))
    write, written = StrikeFiles.write_journal, []

    def write_once(self: StrikeFiles, journal: Mapping[str, Any]) -> None:
        if not written:
            write(self, journal)
        written.append(journal)

    def kill(self: StrikeTable, file: str) -> None:
        raise KeyboardInterrupt

    # A killed process takes nothing back.
    monkeypatch.setattr(StrikeFiles, "write_journal", write_once)
    monkeypatch.setattr(StrikeTable, "remove", kill)
    with pytest.raises(KeyboardInterrupt):
        strikes.remove(added["file"])
    monkeypatch.undo()
    assert strikes.add(blow(), place(0.1), key=key(0)) == added
    strikes.remove(added["file"])
    with pytest.raises(RefusedError):
        strikes.add(blow(), place(0.1), key=key(0))


def test_another_rate_is_refused_at_once(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(), place(0.1), key=key(0))
    with raises(CaptureError, name="sample_rate", value=16000.0) as caught:
        strikes.judge(wav(ring(rate=16000), rate=16000))
    assert "8000 Hz" in str(caught.value)
    # Where it is the only one it may change.
    assert strikes.redo("001.wav", wav(ring(rate=16000), rate=16000))["sample_rate"] == 16000


def test_another_format_becomes_a_wav_of_the_same_samples(tmp_path: Path) -> None:
    sound = np.round(ring(before=0.1) * 32768) / 32768
    book(tmp_path).add(wav(sound, subtype="PCM_16", kind="FLAC"), place(0.1), key=key(0))
    content = (tmp_path / "001.wav").read_bytes()
    assert content[:4] == b"RIFF"
    samples, rate = soundfile.read(io.BytesIO(content))
    assert rate == 8000
    assert np.array_equal(samples, sound)


def test_a_broken_table_is_left_alone(tmp_path: Path) -> None:
    folder = fill(tmp_path / "filled", rows=("a.wav,1,2",))
    before = (folder / "impacts.csv").read_bytes()
    for act in (
        lambda: book(folder).describe(),
        lambda: book(folder).add(blow(), place(0.1), key=key(0)),
        lambda: book(folder).remove("a.wav"),
    ):
        with raises(CaptureError, file=folder / "impacts.csv", row=2, value=3):
            act()
    assert (folder / "impacts.csv").read_bytes() == before


def test_a_journal_that_was_damaged_costs_no_recording(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(), place(0.1), key=key(0))
    (tmp_path / ".avmsf" / strikefiles.JOURNAL).write_text("{")
    assert strikes.add(blow(1), place(0.2), key=key(1))["file"] == "002.wav"
    assert (tmp_path / "001.wav").read_bytes() == blow()
    assert json.loads((tmp_path / ".avmsf" / strikefiles.JOURNAL).read_text())[key(1)]["file"] == "002.wav"


def test_a_link_to_another_strike_is_read_and_never_written_through(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(1), place(0.1), key=key(1))
    (tmp_path / "003.wav").symlink_to("001.wav")
    (tmp_path / "sub").symlink_to(".")
    rows = "001.wav,0,0,0,0,0,1\n003.wav,0.1,0,0,0,0,1\nsub/001.wav,0.2,0,0,0,0,1\n"
    (tmp_path / "impacts.csv").write_text(f"file,x,y,z,nx,ny,nz\n{rows}")
    assert all(strike["readable"] for strike in strikes.describe()["strikes"])
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for file in ("003.wav", "sub/001.wav"):
        for change in (lambda: strikes.redo(file, blow(5)), lambda: strikes.remove(file)):  # noqa: B023
            with raises(RefusedError, file=file, value="link") as refused:
                change()
            assert refused.value.status == 409
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_recording_of_two_rows_is_changed_in_neither(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    strikes.add(blow(1), place(0.1), key=key(1))
    (tmp_path / "impacts.csv").write_text("file,x,y,z\n001.wav,0,0,0\n001.wav,1,0,0\n")
    before = (tmp_path / "impacts.csv").read_bytes()
    for change in (lambda: strikes.redo("001.wav", blow(5)), lambda: strikes.remove("001.wav")):
        with raises(RefusedError, file="impacts.csv", row=3, name="001.wav", value=[2, 3]):
            change()
    assert (tmp_path / "impacts.csv").read_bytes() == before
    assert (tmp_path / "001.wav").read_bytes() == blow(1)


def test_another_tabs_recording_is_neither_overwritten_nor_taken_out(tmp_path: Path) -> None:
    strikes = book(tmp_path)
    added = strikes.add(blow(1), place(0.1), key=key(1))
    assert added["digest"] == hashlib.sha256(blow(1)).hexdigest()
    redone = strikes.redo("001.wav", blow(2), key=key(2), match=added["digest"])
    assert strikes.describe()["strikes"][0]["digest"] == redone["digest"] != added["digest"]
    for change in (
        lambda: strikes.redo("001.wav", blow(3), key=key(3), match=added["digest"]),
        lambda: strikes.remove("001.wav", match=added["digest"]),
    ):
        with raises(RefusedError, file="001.wav", value=added["digest"]) as refused:
            change()
        assert refused.value.status == 409
    # The page has not heard that it was done, and sends it again.
    assert strikes.redo("001.wav", blow(2), key=key(2), match=added["digest"]) == redone
    assert (tmp_path / "001.wav").read_bytes() == blow(2)
    strikes.remove("001.wav", match=redone["digest"])
    assert not (tmp_path / "impacts.csv").exists()


def test_a_recording_of_another_kind_is_redone_as_a_wav_of_its_own_name(tmp_path: Path) -> None:
    before = wav(ring(before=0.1), subtype="PCM_16", kind="FLAC")
    (tmp_path / "hit.flac").write_bytes(before)
    (tmp_path / "hit2.flac").write_bytes(before)
    (tmp_path / "hit2.wav").write_bytes(blow(4))
    (tmp_path / "impacts.csv").write_text("file,x,y,z,note\nhit.flac,0,0,0, a  b\nhit2.flac,0.1,0,0,\n")
    strikes = book(tmp_path)
    redone = strikes.redo("hit.flac", blow(6), key=key(1))
    assert (redone["file"], redone["row"], redone["readable"]) == ("hit.wav", 0, True)
    assert (tmp_path / "hit.wav").read_bytes() == blow(6)
    assert not (tmp_path / "hit.flac").exists()
    assert [path.read_bytes() for path in (tmp_path / ".avmsf" / "removed").glob("hit-*.flac")] == [before]
    assert strikes.redo("hit.flac", blow(6), key=key(1)) == redone
    assert strikes.redo("hit2.flac", blow(7))["file"] == "001.wav"
    assert (tmp_path / "hit2.wav").read_bytes() == blow(4)
    assert (tmp_path / "impacts.csv").read_text().splitlines()[1] == "hit.wav,0,0,0, a  b"


def test_what_the_user_has_written_stays_to_the_last_byte(tmp_path: Path) -> None:
    folder = fill(tmp_path / "filled")
    rows = ('a.wav,0,0,0,"Ann, of \r\n here"', " b.wav ,1e-1,0,0,", "c.wav,0,0,0.2,")
    text = "\r\n".join(['\ufeffFile , X,Y,Z,"Operator\r\nName"', "", *rows])
    (folder / "impacts.csv").write_bytes(text.encode())
    strikes = book(folder)
    strikes.add(blow(3), Place((0.1, 0.0, 1e-3)), key=key(0))
    added = f"{text}\r\n001.wav,0.1,0.0,0.001,\r\n"
    assert (folder / "impacts.csv").read_bytes().decode() == added
    strikes.remove("b.wav")
    assert (folder / "impacts.csv").read_bytes().decode() == added.replace(" b.wav ,1e-1,0,0,\r\n", "")
    strikes.remove("a.wav")
    assert [strike["file"] for strike in strikes.describe()["strikes"]] == ["c.wav", "001.wav"]


def test_an_unchanged_folder_is_judged_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strikes, judged = book(fill(tmp_path / "filled")), []

    def counted(*arguments: object) -> object:
        judged.append(arguments)
        return check(*arguments)

    monkeypatch.setattr(judgements, "check", counted)
    first = strikes.describe()
    assert strikes.describe() == first
    assert len(judged) == 1
    strikes.add(blow(3), place(0.5, direction=None), key=key(0))
    assert len(strikes.describe()["strikes"]) == 4
    assert len(judged) == 2


def test_a_recording_that_is_long_beyond_use_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avmsf.capture.audio.MAX_SAMPLES", 1000)
    with pytest.raises(RefusedError) as refused:
        book(tmp_path).add(blow(), place(0.1), key=key(0))
    assert refused.value.status == 413
