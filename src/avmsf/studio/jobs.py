"""Long computations in a worker process: one at a time, with progress events, ended with the server at the latest.

The process is `python -m avmsf.studio.worker`. It gets a task as one line of JSON and answers with lines of JSON. Its
standard input stays open as long as the server lives, so that the process ends even if the server is killed.
"""

import asyncio
import contextlib
import json
import secrets
import sys
import traceback
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any, Literal, TypeVar, get_args

import anyio
import anyio.to_thread

from avmsf._utils.processes import ending_of
from avmsf._utils.text import printable
from avmsf.errors import AvmsfError
from avmsf.studio.responses import bad_request

Event = dict[str, Any]
Finish = Callable[[Event], Awaitable[Event]]
_STOPPED: Event = {"stage": "cancelled", "words": "stopped"}
"""The last event of a job that somebody has stopped."""
WORKER = (sys.executable, "-m", "avmsf.studio.worker")
_GRACE = 3.0
"""Seconds that a process has to end once its standard input is closed."""
_MAX_STDERR_CHARACTERS = 4000
"""Characters of the process's standard error that are kept."""


class Job:
    """One run of the worker, and its events."""

    def __init__(self, title: str, task: Event, finish: Finish, command: Sequence[str] = WORKER) -> None:
        """Prepare `task` for the worker; `finish` turns its result into the last event, which may have an "error"."""
        self.title, self.task, self.finish, self.command = title, task, finish, command
        self.identifier, self.kind = secrets.token_hex(8), task["task"]
        self.events: list[Event] = []
        self.ended = False
        self._cancelled = self._finishing = False
        self._changed_events = asyncio.Condition()
        self._task: asyncio.Task[Any] | None = None

    async def run(self) -> None:
        """Run to the end; the last event has the outcome."""
        last, self._task = _STOPPED, asyncio.current_task()
        try:
            if not self._cancelled:
                last = await self._work()
            if "result" in last:
                self._finishing = True
                last = await self.finish(last["result"])
        except AvmsfError as error:
            last = {"error": " ".join(str(error).split())}
        except asyncio.CancelledError:
            last = _STOPPED
        except Exception as error:  # whatever it is, the next job must be able to start
            traceback.print_exception(error)
            words = " ".join(f"{type(error).__name__}: {error}".split())[:_MAX_STDERR_CHARACTERS]
            last = {"error": f"{self.title} failed ({words}); see the server's terminal, and start it again"}
        finally:
            await self._publish(last, last=True)

    async def cancel(self) -> bool:
        """Stop the process and wait for its end; completed stages are kept for the next run.

        Return whether it was stopped. A job that already has a result is completed instead.
        """
        if self.ended:
            return False
        if not self._finishing and not self._cancelled:
            self._cancelled = True
            if self._task is not None:
                self._task.cancel()
        async with self._changed_events:
            await self._changed_events.wait_for(lambda: self.ended)
        return self._cancelled

    async def listen(self, *, after: int = 0) -> AsyncIterator[tuple[int, Event]]:
        """Yield the events from number `after` on, counted from 0, until the last one."""
        while not self.ended or after < len(self.events):
            async with self._changed_events:
                await self._changed_events.wait_for(lambda: self.ended or after < len(self.events))  # noqa: B023
            for event in self.events[after:]:
                yield after, event
                after += 1

    async def _work(self) -> Event:
        """Return the event with the worker's result, or with an error; its other events are published."""
        # A result is one line of at most 4 MiB.
        process = await asyncio.create_subprocess_exec(
            *self.command, stdin=PIPE, stdout=PIPE, stderr=PIPE, limit=1 << 22
        )
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        stderr = asyncio.create_task(_tail_of(process.stderr))
        result: Event | None = None
        try:
            # A process that ended without reading its task may have said why.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                process.stdin.write(json.dumps(self.task).encode() + b"\n")
                await process.stdin.drain()
            async for line in process.stdout:
                event = _parse_event(line)
                if "result" in event or "error" in event:
                    result = event
                elif event:
                    await self._publish(event)
            await process.wait()
        finally:
            # The process ends with what it has started when its standard input closes.
            process.stdin.close()
            try:
                await asyncio.wait_for(_tail_of(process.stdout), _GRACE)
            except TimeoutError:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
            text, status = await stderr, await process.wait()
        if result is not None:
            return result
        if status < 0:
            print(printable(text), end="", file=sys.stderr)
            cause = f"was stopped by the system or crashed ({ending_of(status)})"
            return {"error": f"{self.title} {cause}; close other programs if memory is short, and start it again"}
        ending = text.strip().splitlines()[-1:] or ["no message"]
        return {"error": f"{self.title} ended with status {status} and no result: {ending[0]}"}

    async def _publish(self, event: Event, *, last: bool = False) -> None:
        async with self._changed_events:
            self.events.append(event)
            self.ended = last
            self._changed_events.notify_all()


class Jobs:
    """All jobs of a server, one of which runs at most."""

    def __init__(self, command: Sequence[str] = WORKER) -> None:
        self.command = command
        """The worker's process."""
        self._jobs: dict[str, Job] = {}
        self._running: asyncio.Task[None] | None = None

    @property
    def current(self) -> Job | None:
        """The job that runs."""
        return next((job for job in self._jobs.values() if not job.ended), None)

    def failure(self, kind: str) -> str | None:
        """Return the error of the last job of this task; None if it succeeded or has not ended."""
        last = next((job for job in reversed(self._jobs.values()) if job.kind == kind), None)
        if last is None or not last.ended:
            return None
        return "it was stopped" if last.events[-1] == _STOPPED else last.events[-1].get("error")

    def check_idle(self) -> None:
        """Raise RequestError (409) while a job runs."""
        current = self.current
        if current is not None:
            advice, running = "wait for it or stop it", current.identifier
            raise bad_request("job", "none that runs", current.title, advice=advice, status=409, job=running)

    def start(self, title: str, task: Event, finish: Finish) -> Job:
        """Start a job. Raises RequestError (409) while another one runs."""
        self.check_idle()
        job = Job(title, task, finish, self.command)
        self._jobs[job.identifier] = job
        self._running = asyncio.create_task(job.run())
        return job

    def named(self, identifier: str) -> Job:
        """Return a job. Raises RequestError (404)."""
        if identifier not in self._jobs:
            raise bad_request("job", "a known one", identifier, got="another", advice="start it again", status=404)
        return self._jobs[identifier]

    async def close(self) -> None:
        """Stop what runs."""
        if self.current is not None:
            await self.current.cancel()
        if self._running is not None:
            await asyncio.gather(self._running, return_exceptions=True)


def _parse_event(line: bytes) -> Event:
    """Return the event of a line; none for the output of a library."""
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) else {}


async def _tail_of(stream: asyncio.StreamReader) -> str:
    tail = ""
    while part := await stream.read(1 << 16):
        tail = (tail + part.decode(errors="replace"))[-_MAX_STDERR_CHARACTERS:]
    return tail


Result = TypeVar("Result")
Kind = Literal["compute", "prepare", "write", "read"]
"""What a page waits for, what is not needed yet, and changes and reading of files."""


class Threads:
    """The threads of one server, one of each kind at a time, so that recordings are taken in while a search runs."""

    def __init__(self) -> None:
        self._limiters = {kind: anyio.CapacityLimiter(1) for kind in get_args(Kind)}

    async def run(self, kind: Kind, act: Callable[..., Result], *arguments: Any) -> Result:
        """Call a function in a thread, after the others of its kind; it may outlive the server."""
        return await anyio.to_thread.run_sync(act, *arguments, limiter=self._limiters[kind])
