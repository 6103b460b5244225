"""The display of progress: what moves on a terminal, and what a pipe gets."""

import io

import pytest

from avmsf._utils.progress import ProgressDisplay


class Terminal(io.StringIO):
    """Keeps what is written to a terminal."""

    def isatty(self) -> bool:
        return True


def work(display: ProgressDisplay) -> None:
    """Report a stage of two steps and an object, with a name that would be markup or a control sequence."""
    with display:
        display.listener.log("reading [bold]mug\x1b]0;title\x07")
        display.listener.step("splat", 1, 2, "loss [red]1")
        display.listener.ready("splat", 2.0)
        display.listener.ready("modes", None)
        display.objects()("mug", 1, 1)
        display.listener.note("few recordings")


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_stage_is_a_line_with_its_time_on_the_right(stream: type, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", stderr := stream())
    monkeypatch.setenv("TERM", "xterm")
    work(ProgressDisplay())
    lines = stderr.getvalue().splitlines()
    assert any(line.endswith("2.0 s") and "splat" in line for line in lines)
    assert any(line.endswith("cached") and "modes" in line for line in lines)
    assert "\x07" not in stderr.getvalue()
    assert ("[red]1" in stderr.getvalue()) == (stream is Terminal)
    assert len(lines) == 4 or stream is Terminal


@pytest.mark.parametrize(("options", "count"), [({"quiet": True}, 1), ({}, 4), ({"verbose": True}, 5)])
def test_quiet_leaves_notes_and_verbose_adds_parts(
    options: dict, count: int, capsys: pytest.CaptureFixture[str]
) -> None:
    display = ProgressDisplay(**options)
    for _ in range(2):
        work(display)
        assert len(capsys.readouterr().err.splitlines()) == count
