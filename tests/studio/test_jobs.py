"""Jobs: what is heard of them, that one runs at a time, and that nothing of them is left."""

import asyncio
import gc
import json
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from avmsf.errors import CaptureError
from avmsf.studio.jobs import Job, Jobs
from avmsf.studio.responses import RequestError
from event_loop import run_async
from factories.raising import raises

# A loop that a test closes right after a process was killed leaves pipes for the collector, which warns of them.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(autouse=True)
def _collected() -> Iterator[None]:
    """Let the collector warn here, not in some later test."""
    yield
    gc.collect()


def script(text: str) -> tuple[str, ...]:
    start = "import json, os, subprocess, sys, time\ndef say(**event): print(json.dumps(event), flush=True)\n"
    return (sys.executable, "-c", start + text)


async def same(result: Any) -> Any:
    return {"taken": result}


def run(text: str, *, finish: Callable[[Any], Awaitable[Any]] = same) -> list[Any]:
    async def all_events() -> list[Any]:
        job = Job("test", {"task": "x", "size": 3}, finish, script(text))
        task = asyncio.create_task(job.run())
        events = [event async for _, event in job.listen()]
        await task
        return events

    return run_async(all_events())


def test_events_come_in_order_and_the_result_last() -> None:
    text = "task = json.loads(input())\nfor n in range(task['size']): say(stage='count', done=n)\nsay(result={'n': 3})"
    counted = [{"stage": "count", "done": number} for number in range(3)]
    assert run(text) == [*counted, {"taken": {"n": 3}}]


def test_what_a_worker_says_that_does_not_read_its_task_is_heard() -> None:
    async def heard() -> list[Any]:
        job = Job("test", {"long": "x" * 2_000_000}, same, script("os.close(0); time.sleep(0.2); say(result={})"))
        await job.run()
        return [event async for _, event in job.listen()]

    assert run_async(heard()) == [{"taken": {}}]


def test_what_libraries_print_is_no_event() -> None:
    assert run("print('Loading weights: 100%'); print('[1, 2]'); say(result={})") == [{"taken": {}}]


def test_a_job_that_fails_says_why() -> None:
    assert run("say(error='expected two strikes, found one')") == [{"error": "expected two strikes, found one"}]
    [last] = run("raise MemoryError('no more')")
    assert last["error"] == "test ended with status 1 and no result: MemoryError: no more"


@pytest.mark.parametrize(("number", "name"), [(9, "SIGKILL"), (6, "SIGABRT"), (40, "signal 40")])
def test_a_job_that_was_killed_says_by_what_and_not_what_its_process_said(number: int, name: str) -> None:
    [last] = run(f"print('<no Python frame>', file=sys.stderr, flush=True)\nos.kill(os.getpid(), {number})")
    assert last["error"].startswith("test ")
    assert f"({name})" in last["error"]
    assert "Python frame" not in last["error"]


def test_a_result_that_cannot_be_used_is_an_error() -> None:
    async def refuse(result: Any) -> Any:
        raise CaptureError("the field\n cannot be read")

    assert run("say(result={})", finish=refuse) == [{"error": "the field cannot be read"}]


@pytest.mark.parametrize(
    ("raised", "words"), [(OSError(28, "No space left"), "No space left"), (KeyError("revision"), "KeyError: 'rev")]
)
def test_a_finish_that_breaks_is_an_error_and_the_next_job_runs(
    raised: Exception, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    async def broken(result: Any) -> Any:
        raise raised

    async def two() -> tuple[Any, Any]:
        jobs = Jobs()
        first = jobs.start("reconstruct", {}, broken, script("say(result={})"))
        heard = [event async for _, event in first.listen()]
        assert not await first.cancel()
        await jobs.close()
        second = jobs.start("reconstruct", {}, same, script("say(result={})"))
        return heard, [event async for _, event in second.listen()]

    [first], second = run_async(asyncio.wait_for(two(), 20))
    assert "reconstruct failed" in first["error"]
    assert words in first["error"]
    assert second == [{"taken": {}}]
    assert "Traceback" in capsys.readouterr().err


def test_a_result_that_is_being_taken_in_is_told_whoever_stops_the_job() -> None:
    async def stop_late() -> tuple[bool, list[Any]]:
        begun, go = asyncio.Event(), asyncio.Event()

        async def slow(result: Any) -> Any:
            begun.set()
            await go.wait()
            return {"revision": 2}

        job = Jobs().start("test", {}, slow, script("say(result={})"))
        await begun.wait()
        stopping = asyncio.create_task(job.cancel())
        await asyncio.sleep(0.05)
        assert not stopping.done()
        go.set()
        return await stopping, job.events

    stopped, events = run_async(asyncio.wait_for(stop_late(), 20))
    assert not stopped
    assert events == [{"revision": 2}]


def test_who_comes_later_hears_what_was_missed() -> None:
    async def listen() -> tuple[list[Any], list[Any]]:
        job = Job("test", {}, same, script("for n in range(4): say(done=n)\nsay(result={})"))
        await job.run()
        whole = [number async for number, _ in job.listen()]
        return whole, [number async for number, _ in job.listen(after=3)]

    assert run_async(listen()) == ([0, 1, 2, 3, 4], [3, 4])


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def gone(processes: list[int]) -> bool:
    deadline = time.monotonic() + 10
    while any(map(alive, processes)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return not any(map(alive, processes))


LIFELINE = """
import threading
from avmsf._utils.processes import end_with_parent, start_child
threading.Thread(target=end_with_parent, daemon=True).start()
"""
WAITS = "import time; time.sleep(60)"


def pair(begin: str, child: str = WAITS) -> tuple[str, ...]:
    """Return a worker that starts a process, says which both are, and waits."""
    start = f"child = start_child([sys.executable, '-c', {child!r}])\nsay(processes=[os.getpid(), child.pid])\n"
    return script(f"{begin}{start}{WAITS}")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked up in /proc")
@pytest.mark.parametrize(
    "worker", [pair(LIFELINE), pair("from avmsf._utils.processes import start_child\n", LIFELINE + WAITS)]
)
def test_cancelling_ends_all_processes_also_of_a_worker_that_does_not_end_itself(
    worker: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("avmsf.studio.jobs._GRACE", 0.3)

    async def cancel() -> list[Any]:
        jobs = Jobs()
        job = jobs.start("test", {}, same, worker)
        async for _ in job.listen():
            break
        await job.cancel()
        return job.events

    begun = time.monotonic()
    first, last = run_async(cancel())
    assert time.monotonic() - begun < 5
    assert last == {"stage": "cancelled", "words": "stopped"}
    assert gone(first["processes"])


def test_one_job_runs_at_a_time() -> None:
    async def start_two() -> None:
        jobs = Jobs()
        first = jobs.start("reconstruct", {}, same, script("time.sleep(60)"))
        with raises(RequestError, name="job", value="reconstruct") as refused:
            jobs.start("guided edit", {}, same, script(""))
        assert (refused.value.status, refused.value.more) == (409, {"job": first.identifier})
        assert jobs.current is first
        await first.cancel()
        second = jobs.start("guided edit", {}, same, script("say(result={})"))
        assert [event async for _, event in second.listen()] == [{"taken": {}}]
        assert jobs.current is None
        with raises(RequestError, name="job", value="another"):
            jobs.named("another")

    run_async(start_two())


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked up in /proc")
def test_a_worker_and_its_processes_end_where_its_server_was_killed() -> None:
    server = f"import subprocess, time\nsubprocess.Popen({pair(LIFELINE)!r}, stdin=subprocess.PIPE)\ntime.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", server], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        processes = json.loads(process.stdout.readline())["processes"]
        # As long as the server lives nothing happens to them.
        time.sleep(0.3)
        assert all(map(alive, processes))
        process.kill()
    assert gone(processes)


@pytest.mark.parametrize(
    ("words", "failure"),
    [
        pytest.param("say(result={})", None, id="done"),
        pytest.param("say(error='no light')", "no light", id="failed"),
        pytest.param("time.sleep(60)", "it was stopped", id="stopped"),
    ],
)
def test_of_a_kind_the_last_job_says_what_came_of_it(words: str, failure: str | None) -> None:
    async def end() -> list[str | None]:
        jobs = Jobs()
        job = jobs.start("make", {}, same, script(words))
        running = jobs.failure("make")
        if failure == "it was stopped":
            await job.cancel()
        async for _ in job.listen():
            pass
        return [running, jobs.failure("make"), jobs.failure("other")]

    assert run_async(asyncio.wait_for(end(), 20)) == [None, failure, None]
