"""A verb that is silent for long says what it is doing; one that prints, or shows a bar, is left alone."""

import io
import sys
import time
from collections.abc import Callable

import pytest
from rich.console import Console
from rich.file_proxy import FileProxy

from avmsf.cli import check, heartbeat, main, studio
from avmsf.cli.heartbeat import doing
from avmsf.cli.printing import say
from avmsf.cli.progress import ProgressBar

Streams = pytest.CaptureFixture[str]


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every silence count at once."""
    monkeypatch.setattr(heartbeat, "SILENCE_SECONDS", 0.0)
    monkeypatch.setattr(heartbeat, "_TICK_SECONDS", 0.01)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)


def run_check(act: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    def stand_in(options: check.Options) -> int:
        act()
        return 0

    monkeypatch.setattr(check, "run", stand_in)
    monkeypatch.setattr(check.Options, "check_inputs", lambda options: None)
    assert main(["check", "."]) == 0


@pytest.mark.usefixtures("fast")
def test_the_last_line_is_repeated_until_the_verb_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)

    def work() -> None:
        say("counting")
        wait_for(lambda: stream.getvalue().count("counting ... ") > 1)

    run_check(work, monkeypatch)
    lines = stream.getvalue()
    assert lines.count("counting ... 0 s") > 1
    time.sleep(0.05)
    assert stream.getvalue() == lines


@pytest.mark.usefixtures("fast")
def test_steps_of_a_fit_are_seen_in_a_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)

    def work() -> None:
        with ProgressBar() as bar:
            bar.step("fit", 7, 90, "spectral loss 0.500")
            wait_for(lambda: "step 7 of 90" in stream.getvalue())

    run_check(work, monkeypatch)
    assert "step 7 of 90, spectral loss 0.500 ... " in stream.getvalue()


@pytest.mark.usefixtures("fast")
def test_a_moving_bar_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()

    def work() -> None:
        # As `rich` does while a bar is on the terminal.
        monkeypatch.setattr(sys, "stderr", FileProxy(Console(file=stream), stream))
        doing("drawing")
        time.sleep(0.2)
        monkeypatch.undo()

    run_check(work, monkeypatch)
    assert "drawing" not in stream.getvalue()


def test_a_verb_that_prints_often_enough_gets_no_more_lines(monkeypatch: pytest.MonkeyPatch, capsys: Streams) -> None:
    monkeypatch.setattr(heartbeat, "SILENCE_SECONDS", 1000.0)
    monkeypatch.setattr(heartbeat, "_TICK_SECONDS", 0.01)
    run_check(lambda: time.sleep(0.1), monkeypatch)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("fast")
def test_verbs_that_wait_for_their_user_stay_silent(monkeypatch: pytest.MonkeyPatch, capsys: Streams) -> None:
    monkeypatch.setattr(studio, "run", lambda options: time.sleep(0.1) or 0)
    monkeypatch.setattr(studio.Options, "check_inputs", lambda options: None)
    assert main(["studio", "."]) == 0
    assert capsys.readouterr().err == ""
