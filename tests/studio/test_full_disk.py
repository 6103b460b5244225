"""What fails for want of space leaves everything as it was, and can be asked for again."""

import os
from pathlib import Path

import pytest

from avmsf.errors import AvmsfError, CaptureError, StudioError
from avmsf.field.store import load
from avmsf.studio import strike_table as striketable
from avmsf.studio.capturing import StrikeBook
from avmsf.studio.place import Place
from avmsf.studio.session import Revision, Session
from avmsf.studio.strike_files import StrikeFiles
from opened_plate import blow, plate_field

FULL = OSError(28, os.strerror(28))


def struck(folder: Path) -> StrikeBook:
    strikes = StrikeBook(folder)
    for number in range(2):
        strikes.add(blow(number), Place((0.1 * number, 0.2, 0.0), None), key=f"strike-{number:04d}")
    return strikes


def test_a_strike_that_cannot_be_taken_out_stays_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strikes = struck(tmp_path)
    before = (tmp_path / "impacts.csv").read_bytes()

    def refuse(*arguments: object, **named: object) -> None:
        raise CaptureError("No space left on device") from FULL

    for place, name in ((striketable, "write_whole"), (StrikeFiles, "write_journal")):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, refuse)
            with pytest.raises(CaptureError):
                strikes.remove("002.wav")
        assert (tmp_path / "impacts.csv").read_bytes() == before
        assert (tmp_path / "002.wav").read_bytes() == blow(1)
    # What was tried in vain is not taken for done.
    assert strikes.add(blow(1), Place((0.1, 0.2, 0.0), None), key="strike-0001")["file"] == "002.wav"
    strikes.remove("002.wav")
    assert not (tmp_path / "002.wav").exists()
    [kept] = (tmp_path / ".avmsf" / "removed").iterdir()
    assert kept.read_bytes() == blow(1)


def test_taking_a_strike_out_needs_no_space_for_its_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strikes = struck(tmp_path)
    inode = (tmp_path / "002.wav").stat().st_ino
    strikes.remove("002.wav")
    [kept] = (tmp_path / ".avmsf" / "removed").iterdir()
    assert kept.stat().st_ino == inode


def test_a_field_whose_revision_cannot_be_shown_is_not_saved(tmp_path: Path) -> None:
    full = False

    def publish(revision: Revision) -> None:
        if full:
            raise StudioError("No space left on device") from FULL

    session = Session(tmp_path, publish)
    session.open(plate_field())
    full = True
    with pytest.raises(AvmsfError):
        session.save(1, "plate")
    assert list(tmp_path.iterdir()) == []
    full = False
    path, _ = session.save(1, "plate")
    assert len(load(path).bank)
