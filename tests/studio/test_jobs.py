"""Jobs and the worker's tasks: their events, that one runs at a time, and that nothing of them is left."""

import asyncio
import gc
import json
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from avmsf._utils.processes import write_lock
from avmsf.errors import CaptureError, FolderInUseError
from avmsf.field.store import load, save
from avmsf.pipeline.config import CACHE
from avmsf.studio.jobs import Job, Jobs
from avmsf.studio.responses import RequestError
from avmsf.studio.worker import EventWriter, lead, make_field
from factories.capture_folder import fill
from factories.raising import raises
from factories.running import gone
from served import blow, plate_field, run_async

# A loop that a test closes right after a process was killed leaves pipes for the collector, which warns of them.
IGNORED = ("ResourceWarning", "pytest.PytestUnraisableExceptionWarning")
pytestmark = [pytest.mark.filterwarnings(f"ignore::{each}") for each in IGNORED]
TEST = {"task": "test"}
in_proc = pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked up in /proc")


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


def run(text: str, *, task: Any = TEST) -> list[Any]:
    async def all_events() -> list[Any]:
        job = Job("test", task, same, script(text))
        await job.run()
        return [event async for _, event in job.listen()]

    return run_async(asyncio.wait_for(all_events(), 30))


def test_events_come_in_order_and_the_result_last() -> None:
    text = "task = json.loads(input())\nfor n in range(task['size']): say(stage='count', done=n)\nsay(result={'n': 3})"
    counted = [{"stage": "count", "done": number} for number in range(3)]
    assert run(text, task={**TEST, "size": 3}) == [*counted, {"taken": {"n": 3}}]


def test_what_libraries_print_is_no_event_and_a_task_need_not_be_read() -> None:
    assert run("print('Loading weights: 100%'); print('[1, 2]'); say(result={})") == [{"taken": {}}]
    text = "os.close(0); time.sleep(0.2); say(result={})"
    assert run(text, task={**TEST, "long": "x" * 2_000_000}) == [{"taken": {}}]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("say(error='expected two impacts, found one')", "expected two impacts, found one"),
        ("raise MemoryError('no more')", "test ended with status 1 and no result: MemoryError: no more"),
        *(
            (f"print('<no Python frame>', file=sys.stderr, flush=True)\nos.kill(os.getpid(), {number})", f"({name})")
            for number, name in ((9, "SIGKILL"), (6, "SIGABRT"), (40, "signal 40"))
        ),
    ],
)
def test_a_job_that_fails_or_is_killed_says_why(text: str, found: str) -> None:
    [last] = run(text)
    assert found in last["error"]
    assert "Python frame" not in last["error"]


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (CaptureError("the field\n cannot be read"), "the field cannot be read"),
        (OSError(28, "No space left"), "test failed (OSError: [Errno 28] No space left)"),
        (KeyError("revision"), "test failed (KeyError: 'revision')"),
    ],
)
def test_a_result_that_cannot_be_taken_is_an_error_and_the_next_job_runs(raised: Exception, words: str) -> None:
    async def broken(result: Any) -> Any:
        raise raised

    async def two() -> tuple[Any, Any]:
        jobs = Jobs(script("say(result={})"))
        first = jobs.start("test", TEST, broken)
        events = [event async for _, event in first.listen()]
        assert not await first.cancel()
        await jobs.close()
        return events, [event async for _, event in jobs.start("test", TEST, same).listen()]

    [first], second = run_async(asyncio.wait_for(two(), 30))
    assert first["error"].startswith(words)
    assert second == [{"taken": {}}]


def test_who_comes_later_gets_what_was_missed() -> None:
    async def listen() -> list[list[Any]]:
        job = Job("test", TEST, same, script("for n in range(4): say(done=n)\nsay(result={})"))
        await job.run()
        return [[number async for number, _ in job.listen(after=after)] for after in (0, 3)]

    assert run_async(listen()) == [[0, 1, 2, 3, 4], [3, 4]]


LIFELINE = """
import threading
from avmsf._utils.processes import child_process, end_with_parent
threading.Thread(target=end_with_parent, daemon=True).start()
"""
WAITS = "import time; time.sleep(60)"


def pair(begin: str, child: str = WAITS) -> tuple[str, ...]:
    """Return a worker that starts a process, says which both are, and waits."""
    start = f"with child_process([sys.executable, '-c', {child!r}]) as child:\n"
    return script(f"{begin}{start}    say(processes=[os.getpid(), child.pid])\n    {WAITS}")


@in_proc
@pytest.mark.parametrize(
    "worker", [pair(LIFELINE), pair("from avmsf._utils.processes import child_process\n", LIFELINE + WAITS)]
)
def test_cancelling_ends_all_processes_also_of_a_worker_that_does_not_end_itself(worker: tuple[str, ...]) -> None:
    async def cancel() -> list[Any]:
        jobs = Jobs(worker)
        job = jobs.start("test", TEST, same)
        async for _ in job.listen():
            break
        await job.cancel()
        return job.events

    first, last = run_async(cancel())
    assert last == {"stage": "cancelled", "words": "stopped"}
    assert gone(first["processes"])


def test_one_job_runs_at_a_time() -> None:
    async def start_two() -> None:
        jobs = Jobs(script("time.sleep(60)"))
        first = jobs.start("test", TEST, same)
        with raises(RequestError, name="job", value="test") as refused:
            jobs.start("test", {"task": "lead"}, same)
        assert (refused.value.status, refused.value.more) == (409, {"job": first.identifier})
        assert jobs.current is first
        await first.cancel()
        jobs.command = script("say(result={})")
        second = jobs.start("test", {"task": "lead"}, same)
        assert [event async for _, event in second.listen()] == [{"taken": {}}]
        assert jobs.current is None
        with raises(RequestError, name="job", value="another"):
            jobs.named("another")

    run_async(start_two())


@pytest.mark.parametrize(
    ("text", "failure"),
    [("say(result={})", None), ("say(error='no light')", "no light"), ("time.sleep(60)", "it was stopped")],
)
def test_the_last_job_of_a_task_tells_how_it_ended(text: str, failure: str | None) -> None:
    async def end() -> list[str | None]:
        jobs = Jobs(script(text))
        job = jobs.start("test", TEST, same)
        running = jobs.failure("test")
        if failure == "it was stopped":
            await job.cancel()
        async for _ in job.listen():
            pass
        return [running, jobs.failure("test"), jobs.failure("other")]

    assert run_async(asyncio.wait_for(end(), 30)) == [None, failure, None]


def perform(task: Callable[..., Any], values: dict[str, Any], events: Path) -> Any:
    with events.open("w") as stream:
        return task(values, EventWriter(stream))


def events_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.slow
def test_a_field_is_copied_before_another_process_may_replace_it(tmp_path: Path) -> None:
    folder, output, events = fill(tmp_path / "struck"), tmp_path / "made" / "field", tmp_path / "events"
    results: list[Any] = []
    task = {"folder": str(folder), "preset": "default", "modes": 6, "output": str(output)}
    making = threading.Thread(target=lambda: results.append(perform(make_field, task, events)))
    making.start()
    copied_when_free: list[bool] = []
    while making.is_alive():
        try:
            with write_lock(folder / CACHE, "stages", command="avmsf fit", wait=0.0):
                made = (folder / CACHE / "field.safetensors").is_file()
                copied_when_free.append(output.is_file() or not made)
        except FolderInUseError:
            pass
        making.join(0.01)
    assert all(copied_when_free)
    assert results == [{"field": str(folder / CACHE / "field.safetensors"), "output": str(output)}]
    assert output.read_bytes() == Path(results[0]["field"]).read_bytes()
    assert 1 <= len(load(output).bank) <= 6
    assert events_of(events)[0] == {"stage": "capture", "done": 0, "total": 0, "words": "reading the recordings"}


def test_a_field_is_led_towards_a_recording_step_by_step(tmp_path: Path) -> None:
    save(plate_field(), tmp_path / "field")
    (tmp_path / "like.wav").write_bytes(blow())
    names = {name: str(tmp_path / name) for name in ("field", "output")}
    task = {**names, "recording": str(tmp_path / "like.wav"), "steps": 3}
    assert perform(lead, task, tmp_path / "events") == {"output": names["output"]}
    assert not torch.equal(load(names["output"]).bank.frequency, plate_field().bank.frequency)
    steps = events_of(tmp_path / "events")
    assert [(step["stage"], step["total"]) for step in steps] == [("edit", 3)] * len(steps)
    assert all(step["loss"] is None or step["loss"] >= 0 for step in steps)
    assert steps[-1]["done"] == 3
