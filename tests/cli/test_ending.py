"""How a verb ends that cannot go on: by one sentence and a code that says why, and never on somebody else's terms."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType

import pytest

from avmsf.cli import check, main
from avmsf.cli.printing import console, print_json, print_text, say, table
from avmsf.errors import CaptureError

Streams = pytest.CaptureFixture[str]
EVIL = "\x1b]0;title\x07\x9b31m\u202e"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], int]:
    """Let `avmsf check` do something, and return its exit code."""

    def run(act: Callable[[], object]) -> int:
        def stand_in(options: check.Options) -> int:
            act()
            return 0

        monkeypatch.setattr(check, "run", stand_in)
        return main(["check", "folder"])

    return run


@pytest.fixture
def guarded() -> Iterator[None]:
    """Keep a signal that nobody handles from ending the tests."""

    def stray(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"nobody handled signal {number}")

    before = signal.signal(signal.SIGTERM, stray)
    yield
    assert signal.signal(signal.SIGTERM, before) is stray


def a_library_that_was_not_opened() -> OSError:
    """Return what llvmlite raises where its library does not fit into the memory."""
    error = OSError("Could not find/load shared object file 'libllvmlite.so'")
    error.__context__ = OSError("libllvmlite.so: failed to map segment from shared object")
    return error


def wait() -> None:
    for _ in range(200):
        time.sleep(0.01)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("[enforce fail] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        a_library_that_was_not_opened(),
        RecursionError("maximum recursion depth exceeded"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_no_memory_and_no_stack_can_hold_ends_with_a_sentence(
    run: Callable[..., int], error: Exception, capsys: Streams
) -> None:
    def fail() -> None:
        raise error

    assert run(fail) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("avmsf check: ")


def test_an_error_of_another_kind_is_shown_whole(run: Callable[..., int]) -> None:
    def fail() -> None:
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        run(fail)


def test_sigterm_ends_a_verb_as_ctrl_c_does(run: Callable[..., int], guarded: None, capsys: Streams) -> None:
    def terminate() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        wait()

    assert run(terminate) == 143
    assert capsys.readouterr().err == "avmsf check: interrupted\n"


def test_ctrl_c_in_a_finalizer_ends_the_verb_all_the_same(run: Callable[..., int], capsys: Streams) -> None:
    class Closing:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            wait()

    def close() -> None:
        Closing()
        wait()

    assert run(close) == 130
    assert capsys.readouterr().err == "avmsf check: interrupted\n"


def test_a_terminal_obeys_nothing_that_stands_in_a_file(run: Callable[..., int], capsys: Streams) -> None:
    def fail() -> None:
        raise CaptureError(f"format 7, written by {EVIL}")

    assert run(fail) == 2
    say(EVIL)
    print_text(EVIL)
    print_json({"name": EVIL})
    screen = console(errors=False)
    screen.print(EVIL)
    screen.print(table(EVIL, ["mode"], [[EVIL]]))
    out, err = capsys.readouterr()
    assert not {*out, *err} & set("\x1b\x07\x9b\u202e")
    assert "title" in out
    assert "title" in err
