"""Names of files that a progress bar shows do nothing to the terminal, and their brackets are no markup."""

import io
import sys
from collections.abc import Callable

import pytest

from avmsf.cli.object_bar import ObjectBar
from avmsf.cli.overall_bar import OverallBar
from avmsf.cli.scene_bar import SceneBar
from avmsf.features.lift import LiftProgress

EVIL = "\x1b]0;title\x07[/b].png"


class Terminal(io.StringIO):
    """A standard error that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def show_object() -> None:
    with ObjectBar() as bar:
        bar.show(EVIL, done=1, total=2)


def show_view() -> None:
    with SceneBar() as bar:
        bar.lifting(LiftProgress(done=1, total=2, view=EVIL))


def show_stage() -> None:
    with OverallBar({"check": 1.0}) as bar:
        bar.log(EVIL)
        bar._bar.refresh()


@pytest.mark.parametrize("show", [show_object, show_view, show_stage])
def test_a_bar_shows_names_as_text(monkeypatch: pytest.MonkeyPatch, show: Callable[[], None]) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "150")
    show()
    assert "\x1b]0;title" not in terminal.getvalue()
    assert r"\x1b]0;title\x07[/b].png" in terminal.getvalue()
