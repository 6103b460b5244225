"""The display of progress: what moves on a terminal, and what a pipe gets."""

import io

import pytest

from avmsf._utils.progress import ProgressDisplay


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "options", "count"),
    [
        (io.StringIO, {"shown": False}, 1),
        (io.StringIO, {}, 4),
        (io.StringIO, {"verbose": True}, 5),
        (Terminal, {}, None),
    ],
)
def test_a_stage_is_a_line_quiet_leaves_notes_and_verbose_adds_parts(stream, options, count, monkeypatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr("sys.stderr", stderr := stream())
    display = ProgressDisplay(**options)
    # Names that would be markup or a control sequence.
    for _ in range(2):
        with display:
            display.listener.log("reading [bold]mug\x1b]0;title\x07")
            display.listener.step("splat", 1, 2, "loss [red]1")
            display.listener.ready("splat", 2.0)
            display.listener.ready("modes", None)
            display.objects()("mug", 1, 1)
            display.listener.note("few recordings")
    lines = stderr.getvalue().splitlines()
    assert count is None or len(lines) == 2 * count
    assert options or any(line.endswith("2.0 s") and "splat" in line for line in lines)
    assert "\x07" not in stderr.getvalue()
    assert ("[red]1" in stderr.getvalue()) == (stream is Terminal)
