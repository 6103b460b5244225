"""How a verb ends that cannot go on: by one sentence and an exit code."""

import io
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import torch

from avmsf.cli import check, main
from avmsf.cli.output import display, print_json, say, show, table
from avmsf.errors import CaptureError
from factories.verbs import results_of

Streams = pytest.CaptureFixture[str]
STORED = Path(__file__).parents[1] / "field" / "data" / "format-8" / "mixture.safetensors"
EVIL = "\x1b]0;title\x07\x9b31m\u202e"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], int]:
    """Let `avmsf check` do something, and return its exit code."""

    def run(act: Callable[[], object]) -> int:
        def stand_in(options: check.Options) -> int:
            act()
            return 0

        monkeypatch.setattr(check, "run", stand_in)
        monkeypatch.setattr(check.Options, "check_inputs", lambda options: None)
        return main(["check", "."])

    return run


@pytest.fixture
def guarded() -> Iterator[None]:
    """Keep a signal that nobody handles from ending the tests."""

    def stray(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"nobody handled signal {number}")

    before = signal.signal(signal.SIGTERM, stray)
    yield
    assert signal.signal(signal.SIGTERM, before) is stray


@pytest.fixture
def own_ctrl_c() -> Iterator[None]:
    """Let SIGINT raise KeyboardInterrupt, as in a new process: libraries of earlier tests may have changed that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if before is not None:
        signal.signal(signal.SIGINT, before)


def wait() -> None:
    for _ in range(200):
        time.sleep(0.01)


@pytest.mark.parametrize("act", [lambda: bytearray(1 << 62), lambda: torch.empty(1 << 60, dtype=torch.uint8)])
def test_missing_memory_ends_a_verb_with_a_sentence(run, act, capsys):
    assert run(act) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("avmsf check: ")


def test_an_error_of_this_package_shows_where_it_arose(run: Callable[..., int]) -> None:
    def fail() -> None:
        raise ImportError("a bug")

    with pytest.raises(ImportError):
        run(fail)


def test_sigterm_ends_a_verb_as_ctrl_c_does(run: Callable[..., int], guarded: None, capsys: Streams) -> None:
    def terminate() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        wait()

    assert run(terminate) == 143
    assert capsys.readouterr().err == "avmsf check: interrupted\n"


def test_an_ignored_sigterm_stays_ignored(run: Callable[..., int]) -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        assert run(lambda: os.kill(os.getpid(), signal.SIGTERM)) == 0
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def test_ctrl_c_in_a_finalizer_ends_the_verb_all_the_same(run, own_ctrl_c, capsys):
    class Closing:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            wait()

    def close() -> None:
        Closing()
        wait()

    assert run(close) == 130
    assert capsys.readouterr().err == "avmsf check: interrupted\n"


def test_a_terminal_obeys_nothing_that_stands_in_a_file(run, capsys, monkeypatch):
    def fail() -> None:
        raise CaptureError(f"format 7, written by {EVIL}")

    assert run(fail) == 2
    say(EVIL)
    monkeypatch.setattr(display, "json", True)
    print_json({"name": EVIL})
    monkeypatch.setattr(display, "json", False)
    show(table(EVIL, ["mode"], [[EVIL]]))
    out, err = capsys.readouterr()
    assert not {*out, *err} & set("\x1b\x07\x9b\u202e")
    assert "title" in out
    assert "title" in err


ERRORS: dict[str, dict[str, object]] = {
    "modes nowhere": {"file": "nowhere"},
    "fit nowhere -o f.safetensors --device tpu": {"file": "nowhere"},
    "fitt": {"value": "fitt"},
    "--quiet": {"value": None},
    "fit nowhere -o f.safetensors --seed many": {"name": "fit"},
    "render --position 0 0 0": {"name": "render"},
    "render f.safetensors --position 0,0,0 -o s": {"name": "render"},
}


@pytest.mark.parametrize("words", ERRORS)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_an_error_is_one_line_and_with_json_an_object_too(words: str, encoding: str, capsys: Streams) -> None:
    # It decides what boxes tyro draws with.
    for stream in (sys.stdout, sys.stderr):
        assert isinstance(stream, io.TextIOWrapper)
        stream.reconfigure(encoding=encoding)
    assert main(words.split()) == 2
    plain = capsys.readouterr()
    answer, err = results_of(capsys, *words.split(), code=2)
    error = answer["error"]
    assert (plain.out, plain.err) == ("", err)
    assert set(error) == {"message", "file", "row", "name", "value"}
    assert {key: error[key] for key in ERRORS[words]} == ERRORS[words]
    assert err.splitlines() in ([error["message"]], [f"avmsf {words.split()[0]}: {error['message']}"])
    assert not set("│─╭╰") & set(err)


CODE = "import sys; from avmsf.cli import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize("closing", [">&-", ">&- 2>&-"])
@pytest.mark.parametrize(("words", "code"), [("--version", 0), ("fit --help", 0), ("fitt", 2), ("info nowhere", 2)])
def test_a_closed_descriptor_changes_no_exit_code(words: str, code: int, closing: str) -> None:
    command = f"exec {shlex.quote(sys.executable)} -c {shlex.quote(CODE)} {words} {closing}"
    ran = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60, check=False)
    assert ran.returncode == code
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize("words", ["--help", "fit --help", "--json fitt", "info FIELD --json"])
def test_a_closed_output_ends_silently(words: str) -> None:
    command = [sys.executable, "-c", CODE, *words.replace("FIELD", str(STORED)).split()]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None
    run.stdout.close()
    _, err = run.communicate(timeout=300)
    assert b"BrokenPipe" not in err
    assert run.returncode == 141
