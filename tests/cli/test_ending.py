"""How a verb ends, and many captures at a time."""

import csv
import io
import math
import multiprocessing
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import torch

from avmsf._utils import progress
from avmsf._utils.progress import ProgressDisplay
from avmsf.cli import check, main
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.output import display, print_json, say, show, table
from avmsf.cli.paths import InputError, OutputError
from avmsf.errors import CaptureError
from avmsf.field.store import save
from factories.made_fields import positional, sounding
from factories.plate_capture import TINY, fill_plate
from factories.raising import raises
from factories.verbs import Streams, results_of, run_verb

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


def wait() -> None:
    for _ in range(200):
        time.sleep(0.01)


@pytest.mark.parametrize("act", [lambda: bytearray(1 << 62), lambda: torch.empty(1 << 60, dtype=torch.uint8)])
def test_missing_memory_ends_a_verb_with_a_sentence(run, act, capsys):
    assert run(act) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("avmsf check: ")


def test_an_error_of_this_package_shows_where_it_arose(run: Callable[..., int]) -> None:
    for bug in (ImportError("a bug"), FileNotFoundError(2, "No such file or directory", "page.html")):

        def fail(error: Exception = bug) -> None:
            raise error

        with pytest.raises(type(bug)):
            run(fail)


def test_a_name_that_the_system_refuses_ends_a_verb_with_a_sentence(capsys: Streams) -> None:
    for words in (["info", 300 * "x"], ["demo", 300 * "x"]):
        assert main(words) == 2
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith(f"avmsf {words[0]}: xxx")
        assert "x: expected a readable or writable path, got 'File name too long'; " in line


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
    "--quiet": {"value": "--quiet"},
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


@pytest.mark.parametrize("words", ["--help", "fit --help", "--json fitt", "fit mug --print-config"])
def test_a_closed_output_ends_silently(words: str) -> None:
    command = [sys.executable, "-c", CODE, *words.split()]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.stdout is not None
    run.stdout.close()
    _, err = run.communicate(timeout=300)
    assert b"BrokenPipe" not in err
    assert run.returncode == 141


NETWORK = ("--gain-model", "network", "--without-shape", *TINY)
SMOOTH = ("--gain-model", "smooth", "--train-count", "5", *TINY)
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


@pytest.fixture
def fields(tmp_path: Path) -> list[str]:
    """Return the files of two fields, and of one that is damaged."""
    for name in ("a", "b", "damaged"):
        save(sounding(positional()), tmp_path / f"{name}.safetensors")
    damaged = tmp_path / "damaged.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    return [str(tmp_path / f"{name}.safetensors") for name in ("a", "b", "damaged")]


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Return a plate, and the same plate with a recording less."""
    folder = tmp_path_factory.mktemp("captures")
    first = fill_plate(folder / "a")
    shutil.copytree(first, folder / "b")
    lines = (first / "impacts.csv").read_text().splitlines(keepends=True)
    (folder / "b" / "impacts.csv").write_text("".join(lines[:-1]))
    return first, folder / "b"


def fit(captures: tuple[Path, ...], output: Path, *words: str) -> list[str]:
    caches = output.with_name(f"{output.name} caches")
    return ["fit", *map(str, captures), "-o", str(output), "--cache", str(caches), *words]


def fields_one_by_one(captures: tuple[Path, ...], folder: Path, *words: str) -> dict[str, bytes]:
    """Return the bytes of the fields that single commands write, each on one thread."""
    made = {}
    for capture in captures:
        path = folder / f"{capture.name}.safetensors"
        command = ["fit", capture, "-o", path, "--cache", folder / capture.name, *words]
        subprocess.run([sys.executable, "-m", "avmsf", *map(str, command)], env=os.environ | ONE_THREAD, check=True)
        made[path.name] = path.read_bytes()
    return made


def table_of(output: Path) -> dict[str, dict[str, str]]:
    with (output / "results.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def states(streams: Streams, *words: str, code: int = 0) -> dict[str, str]:
    results, _ = results_of(streams, *words, code=code)
    return {name: each["state"] for name, each in results["results"].items()}


def test_all_are_made_but_what_fails_for_a_reason_and_kept_while_nothing_changes(fields, tmp_path, capsys):
    (a, b, damaged), pages = fields, tmp_path / "pages"
    words = ["--to", "gltf", "--contacts", "20", "-o", str(pages)]
    assert main(["export", a, damaged, *words, "--workers", "2"]) == 2
    shown, rows = capsys.readouterr().out, table_of(pages)
    assert [row["state"] for row in rows.values()] == ["done", "failed"]
    assert "damaged.safetensors" in rows["damaged"]["failure"]
    assert f"failed: damaged: {rows['damaged']['failure']}" in shown
    assert int(rows["a"]["bytes"]) == (pages / "a.glb").stat().st_size
    assert run_verb("export", a, *words[:-1], str(tmp_path / "alone.glb")) == 0
    assert (pages / "a.glb").read_bytes() == (tmp_path / "alone.glb").read_bytes()
    # What is there and would change is replaced only if that is asked for, which is no change itself.
    shutil.copy(pages / "a.glb", pages / "b.glb")
    assert states(capsys, "export", a, b, *words, code=2) == {"a": "as before", "b": "failed"}
    assert states(capsys, "export", a, b, *words, "--overwrite") == {"a": "as before", "b": "done"}


def test_ctrl_c_keeps_what_is_done(fields, tmp_path, capsys, monkeypatch):
    pages = tmp_path / "pages"
    words = ["export", *fields[:2], "--to", "gltf", "-o", str(pages)]
    say = ProgressDisplay.say
    # Before any is done, and after one.
    for last, seconds in (("running a for 0 s (0 of 2, ", 0.0), ("a: done", math.inf)):

        def stop(self: ProgressDisplay, text: str, *, always: bool = False, last: str = last) -> None:
            if text.startswith(last):
                raise KeyboardInterrupt
            say(self, text, always=always)

        with monkeypatch.context() as patched:
            patched.setattr(ProgressDisplay, "say", stop)
            patched.setattr(progress, "LINE_SECONDS", seconds)
            assert main(words) == 130
        assert any(pages.glob("*.csv")) == (last == "a: done")
    assert {name: row["state"] for name, row in table_of(pages).items()} == {"a": "done", "b": "not reached"}
    assert states(capsys, *words) == {"a": "as before", "b": "done"}


def test_of_many_a_file_that_the_command_did_not_make_is_not_replaced(captures, tmp_path):
    words = [*map(str, captures[:2]), "--until", "surface", "-o", str(tmp_path / "many")]
    made = tmp_path / "many" / f"{captures[0].name}.ply"
    made.parent.mkdir()
    made.write_bytes(b"a scan")
    record = made.with_name(f"{made.name}.stage.json")
    for _ in range(2):
        tasks = FitOptions.parse(words).tasks()
        assert [tasks[each.name].overwrite for each in captures[:2]] == [record.exists(), False]
        record.touch()


def test_pictures_that_are_asked_for_later_are_drawn(captures, tmp_path, capsys):
    words = ["fit", *map(str, captures[:2]), "--until", "surface", "-o", str(tmp_path / "many")]
    for plots, state in (((), "done"), ((), "as before"), (("--plots", str(tmp_path / "plots")), "done")):
        assert {*states(capsys, *words, *plots).values()} == {state}
    assert [*(tmp_path / "plots").rglob("*.png")]


def test_what_cannot_be_of_many_is_refused(captures: tuple[Path, ...], tmp_path: Path) -> None:
    twice = tmp_path / captures[0].name
    shutil.copytree(captures[0], twice)
    with raises(OutputError, name="--output"):
        run_verb("fit", *map(str, captures))
    with raises(InputError, file=twice, value=twice.name):
        run_verb(*fit((captures[0], twice), tmp_path / "many"))
    (tmp_path / "features.npz").touch()
    with raises(InputError, name="--features"):
        run_verb(*fit(captures, tmp_path / "many", "--features", str(tmp_path / "features.npz")))
    for verb, *words in (("fit",), ("export", "--to", "web", "-o", str(tmp_path / "x"))):
        with raises(InputError, name="inputs"):
            run_verb(verb, *words)


@pytest.mark.slow
def test_fields_of_many_on_a_cluster_are_those_of_each(captures, tmp_path, capsys):
    pytest.importorskip("ray")
    results, _ = results_of(capsys, *fit(captures, tmp_path / "many", *SMOOTH, "--ray", "local"))
    found, row = results["results"]["a"], table_of(tmp_path / "many")["a"]
    assert float(row["relative STFT error"]) == pytest.approx(found["scores"]["field"]["relative_stft"], rel=0.01)
    assert float(row["by leave-one-out"]) == pytest.approx(found["report"]["quality"]["error"], rel=0.01)
    for name, content in fields_one_by_one(captures, tmp_path / "alone", *SMOOTH).items():
        assert (tmp_path / "many" / name).read_bytes() == content


@pytest.mark.slow
def test_pages_of_many_have_the_captures_of_their_names(captures, fields, tmp_path, capsys):
    words = ["--to", "web", "--contacts", "20", "--capture"]
    assert run_verb("export", fields[0], *words, str(captures[0]), "-o", str(tmp_path / "alone.html")) == 0
    together = ["export", *fields[:2], *words, str(captures[0].parent), "-o", str(tmp_path / "pages")]
    assert states(capsys, *together) == {"a": "done", "b": "done"}
    assert (tmp_path / "pages" / "a.html").read_bytes() == (tmp_path / "alone.html").read_bytes()


@pytest.mark.slow
def test_workers_that_are_killed_change_nothing(captures: tuple[Path, ...], tmp_path: Path) -> None:
    chance, killed, ended = random.Random(0), list[int | None](), threading.Event()
    alone = fields_one_by_one(captures, tmp_path / "alone", *NETWORK)

    def kill() -> None:
        while len(killed) < 3 and not ended.wait(chance.uniform(0, 3)):
            running = [each for each in multiprocessing.active_children() if each.pid not in killed]
            if running:
                victim = chance.choice(running)
                victim.kill()
                killed.append(victim.pid)

    killer = threading.Thread(target=kill)
    killer.start()
    assert main(fit(captures, tmp_path / "many", *NETWORK, "--workers", "2")) == 0
    ended.set()
    killer.join()
    assert len(killed) == 3
    for name, content in alone.items():
        assert (tmp_path / "many" / name).read_bytes() == content
