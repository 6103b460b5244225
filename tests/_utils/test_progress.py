"""Progress in a file or a pipe: lines that repeat, and none for short work or where none is wanted."""

import io
import sys
import time

import pytest

from avmsf._utils import progress
from avmsf._utils.progress import working


def lines_of(monkeypatch: pytest.MonkeyPatch, *, wanted: int, shown: bool = True) -> list[str]:
    """Return what is printed until so many lines have come, or for a tenth of a second."""
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    end = time.monotonic() + (30.0 if wanted else 0.1)
    with working("counting", shown=shown):
        while time.monotonic() < end and (not wanted or stream.getvalue().count("\n") < wanted):
            time.sleep(0.01)
    return stream.getvalue().splitlines()


def test_lines_repeat_in_a_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "REPEAT_SECONDS", 0.01)
    lines = lines_of(monkeypatch, wanted=2)
    assert len(lines) >= 2
    assert all(line.startswith("counting ... ") for line in lines)
    assert lines_of(monkeypatch, wanted=0, shown=False) == []


def test_short_work_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert lines_of(monkeypatch, wanted=0) == []
