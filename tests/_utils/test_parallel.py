"""Tasks in processes of their own: all are done whichever process is killed, and none outlives who waits for it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from avmsf._utils.parallel import MAX_STARTS, run_tasks, workers_at
from avmsf._utils.processes import child_process
from avmsf.errors import FitError, WorkerError
from factories.running import gone


def told(number: int) -> tuple[int, int, str | None]:
    if number == 2:
        raise FitError("no fit", name="two")
    return number, os.getpid(), os.environ.get("OMP_NUM_THREADS")


def dies_at_first(place: tuple[Path, int]) -> int:
    """Kill this process as often as asked, and count its starts in a file."""
    file, deaths = place
    with open(file, "a") as starts:
        starts.write("x")
    if file.stat().st_size <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    return file.stat().st_size


def stays(file: Path) -> None:
    """Start a process, write the number of both, and end never."""
    with child_process([sys.executable, "-c", "import time; time.sleep(600)"]) as child:
        file.with_suffix(".part").write_text(f"{os.getpid()} {child.pid}")
        file.with_suffix(".part").rename(file)
        time.sleep(600)


def numbers_in(file: Path) -> list[int]:
    return [int(number) for number in file.read_text().split()]


def run(act: object, arguments: dict, count: int = 2, address: str | None = None) -> dict:
    found: dict[str, object] = {}
    with workers_at(count, address, raising=FitError) as workers:
        run_tasks(act, arguments, workers, found.__setitem__, lambda text: None)
    return found


def test_tasks_return_and_raise_in_processes_of_one_thread() -> None:
    found = run(told, {"a": 1, "b": 2, "c": 3})
    assert isinstance(found["b"], FitError)
    assert (str(found["b"]), found["b"].name) == ("no fit", "two")
    assert "in told" in found["b"].__notes__[0]
    assert [(found[name][0], found[name][2]) for name in "ac"] == [(1, "1"), (3, "1")]
    assert len({os.getpid(), found["a"][1], found["c"][1]}) == 3


class UnreadableError(Exception):
    def __init__(self, one: str, other: str) -> None:
        super().__init__(one)


def unreadable(_: int) -> None:
    raise UnreadableError("one", "other")


def test_an_error_that_cannot_be_pickled_costs_its_task_alone() -> None:
    found = run(unreadable, {"a": 1}) | run(told, {"b": 1})
    assert isinstance(found["a"], WorkerError)
    assert "UnreadableError" in str(found["a"])
    assert found["b"][0] == 1


@pytest.mark.slow
def test_a_cluster_of_ray_runs_tasks_alike() -> None:
    pytest.importorskip("ray")
    found = run(int, {"a": "3", "b": "x"}, address="local") | run(os.getenv, {"c": "OMP_NUM_THREADS"}, address="local")
    assert (found["a"], type(found["b"]), found["c"]) == (3, ValueError, "1")


def test_a_killed_process_costs_its_task_alone_which_begins_again(tmp_path: Path) -> None:
    survives, never = (tmp_path / "survives", 1), (tmp_path / "never", 99)
    found = run(dies_at_first, {"never": never, "survives": survives}, count=1)
    assert found["survives"] == 2
    assert never[0].stat().st_size == MAX_STARTS
    assert isinstance(found["never"], WorkerError)
    assert found["never"].value == "SIGKILL"


def test_who_stops_waiting_ends_all(tmp_path: Path) -> None:
    def stop(name: str, outcome: object) -> None:
        while not (tmp_path / "numbers").exists():
            time.sleep(0.05)
        raise KeyboardInterrupt

    with workers_at(2, raising=FitError) as workers, pytest.raises(KeyboardInterrupt):
        run_tasks(_either, {"long": tmp_path / "numbers", "short": tmp_path / "short"}, workers, stop, print)
    assert gone(numbers_in(tmp_path / "numbers"))


def _either(file: Path) -> None:
    if file.name == "numbers":
        stays(file)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked for in /proc")
def test_workers_end_with_their_parent_however_that_ends(tmp_path: Path) -> None:
    file = tmp_path / "numbers"
    lines = (
        f"import sys; sys.path[:0] = {sys.path!r}",
        "from pathlib import Path",
        "from test_parallel import run, stays",
        f"run(stays, {{'a': Path({str(file)!r})}})",
    )
    (tmp_path / "parent.py").write_text("\n".join((*lines[:3], "if __name__ == '__main__':", f"    {lines[3]}")))
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py")])
    while not file.exists():
        assert parent.poll() is None
        time.sleep(0.05)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert gone(numbers_in(file))
