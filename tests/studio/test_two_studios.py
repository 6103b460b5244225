"""Two studios on one capture folder: neither loses what the other has written."""

import csv
import threading
from collections.abc import Iterable
from pathlib import Path

import pytest

from avmsf._utils.locks import write_lock
from avmsf.pipeline.config import CACHE
from avmsf.studio import strike_files as strikefiles
from avmsf.studio.capturing import StrikeBook
from avmsf.studio.place import Place
from avmsf.studio.refusal import RefusedError
from avmsf.studio.strike_files import StrikeFiles
from opened_plate import blow

PLACE = Place((0.1, 0.2, 0.0), None)


def test_strikes_of_two_studios_at_once_are_all_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = threading.Barrier(2)
    choose = StrikeFiles.next_name

    def choose_at_once(self: StrikeFiles, taken: Iterable[str]) -> str:
        name = choose(self, taken)
        try:
            # Without a lock both are here at the same time, and have chosen the same name.
            both.wait(0.5)
        except threading.BrokenBarrierError:
            both.reset()
        return name

    monkeypatch.setattr(StrikeFiles, "next_name", choose_at_once)
    added: dict[int, str] = {}

    def strike(number: int) -> None:
        added[number] = StrikeBook(tmp_path).add(blow(number), PLACE, key=f"strike-{number:04d}")["file"]

    studios = [threading.Thread(target=strike, args=(number,)) for number in range(2)]
    for each in studios:
        each.start()
    for each in studios:
        each.join()
    with open(tmp_path / "impacts.csv", newline="") as file:
        rows = [cells[0] for cells in csv.reader(file)]
    assert sorted(rows) == ["001.wav", "002.wav", "file"]
    assert {number: (tmp_path / name).read_bytes() == blow(number) for number, name in added.items()} == {
        0: True,
        1: True,
    }


def test_a_change_that_another_process_does_not_let_through_is_refused_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strikefiles, "_WAIT", 0.1)
    strikes = StrikeBook(tmp_path)
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with write_lock(tmp_path / CACHE, "capture", command="avmsf studio"):
            held.set()
            done.wait()

    other = threading.Thread(target=hold)
    other.start()
    try:
        held.wait()
        with pytest.raises(RefusedError) as refused:
            strikes.add(blow(0), PLACE, key="strike-0000")
    finally:
        done.set()
        other.join()
    assert refused.value.status == 503
    assert not (tmp_path / "impacts.csv").exists()
    assert strikes.add(blow(0), PLACE, key="strike-0000")["file"] == "001.wav"


def test_stages_that_are_made_meanwhile_do_not_keep_strikes_out(tmp_path: Path) -> None:
    with write_lock(tmp_path / CACHE, "stages", command="avmsf reconstruct"):
        assert StrikeBook(tmp_path).add(blow(0), PLACE, key="strike-0000")["file"] == "001.wav"
