"""Names of files that a progress bar shows do nothing to the terminal, and their brackets are no markup."""

import io
import sys

import pytest

from avmsf.cli.progress import ProgressBar

EVIL = "\x1b]0;title\x07[/b].png"


class Terminal(io.StringIO):
    """A standard error that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_bar_shows_names_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "150")
    with ProgressBar() as bar:
        bar.step("features", 1, 2, EVIL)
        bar.objects(EVIL, 1, 2)
    assert "\x1b]0;title" not in terminal.getvalue()
    assert r"\x1b]0;title\x07[/b].png" in terminal.getvalue()
