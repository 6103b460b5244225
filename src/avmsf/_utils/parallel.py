"""Tasks beside each other, each in a process of its own: on this computer, or on those of a ray cluster.

A task is a function of a module with one argument; what it returns or raises comes back, and its memory is free then. A
process that ends early, killed or for want of memory, costs its own task alone, which begins again.
"""

import os
import pickle
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import connection, get_context
from multiprocessing.context import SpawnProcess
from types import ModuleType
from typing import Any, TypeVar

from avmsf._utils.processes import end_with_parent, ending_of
from avmsf.errors import AvmsfError, WorkerError, from_extra

Argument = TypeVar("Argument")
Result = TypeVar("Result")
MAX_STARTS = 4
"""Processes that a task gets in turn where they end early: more than a computer loses by chance, few where memory is
too small for the task."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
"""What libraries read when they are loaded: sums in one order, and workers that do not stall each other."""
_WAIT = 1.0
"""Seconds after which waiting is interrupted, so that Ctrl-C gets through."""
_NAMED = 8
"""Tasks that a line names, those that have run longest."""
_GRACE = 3.0
"""Seconds that a process has to end before it is killed."""


class _Processes:
    """Processes of this computer, new for each task, which is the end of its pipe; they end with this one."""

    state = "running"

    def __init__(self, count: int) -> None:
        self.count, self.processes = count, dict[connection.Connection, SpawnProcess]()

    def start(self, act: Callable[[Argument], object], argument: Argument) -> connection.Connection:
        """Begin a task and return its handle."""
        context = get_context("spawn")
        ours, theirs = context.Pipe()
        # Pickled here: what a task needs is loaded once its process knows how many threads it has.
        self.processes[ours] = context.Process(target=_work, args=(theirs, pickle.dumps((act, argument))), daemon=True)
        with _environment(_ONE_THREAD), theirs:
            self.processes[ours].start()
        return ours

    def wait(self, tasks: Collection[connection.Connection]) -> Collection[Any]:
        """Return those that are done, after a second at most."""
        return connection.wait(tasks, _WAIT)

    def outcome(self, task: connection.Connection) -> Any:
        """Return what a task that is done returned or raised. Raises WorkerError."""
        try:
            return pickle.loads(task.recv_bytes())
        except (EOFError, OSError):  # OSError: it ended while it answered.
            self.processes[task].join()
            raise _ended_early(ending_of(self.processes[task].exitcode or 0), "with fewer --workers") from None
        finally:
            self.stop([task])

    def stop(self, tasks: Collection[connection.Connection]) -> None:
        """End tasks that run, and what they started."""
        for task in tasks:
            task.close()
        for task in tasks:
            process = self.processes.pop(task)
            process.join(_GRACE)
            process.kill()
            process.join()


class _Cluster:
    """Processes of a ray cluster, which has a queue of its own, with the methods of `_Processes`."""

    count, state = float("inf"), "submitted"

    def __init__(self, ray: ModuleType) -> None:
        self.ray = ray
        # A process that serves one call leaves no memory behind.
        self.remote = ray.remote(num_cpus=1, max_retries=0, max_calls=1)(_outcome)

    def start(self, act: Callable[[Argument], object], argument: Argument) -> Any:
        return self.remote.remote(act, argument)

    def wait(self, tasks: Collection[Any]) -> Collection[Any]:
        return self.ray.wait(list(tasks), num_returns=1, timeout=_WAIT)[0]

    def outcome(self, task: Any) -> Any:
        try:
            return self.ray.get(task)
        except self.ray.exceptions.RayTaskError as error:  # Its process could not load what the task needs.
            return error.cause
        except self.ray.exceptions.RayError as error:
            raise _ended_early(str(error).splitlines()[0], "on a cluster with fewer --num-cpus") from error

    def stop(self, tasks: Collection[Any]) -> None:
        for task in tasks:
            self.ray.cancel(task, force=True)


Workers = _Processes | _Cluster
"""Where tasks run, each in a process on one thread; `count` tasks are begun before the first of them is done;
`state` is what begun ones are said to be."""


@contextmanager
def workers_at(count: int, address: str | None = None, *, raising: type[AvmsfError]) -> Iterator[Workers]:
    """Yield `count` processes of this computer, or the cluster at an address of ray: `auto`, or `local` for one here.

    Its computers must see all files under the same paths. Raises `raising` for no worker, where ray is needed and not
    installed, and where there is no such cluster.
    """
    if count < 1:
        raise raising.expected("1 worker or more", count, name="workers")
    if address is None:
        yield _Processes(count)
        return
    ray = _imported_ray(raising)
    try:
        ray.init(address, log_to_driver=False, logging_level="error", runtime_env={"env_vars": _ONE_THREAD})
    except (ConnectionError, RuntimeError, ValueError) as error:
        wanted, advice = "a cluster to connect to", "check that it runs and has this address"
        reason = " ".join(str(error).split())
        raise raising.expected(wanted, address, got=reason, name="ray", advice=advice) from error
    try:
        yield _Cluster(ray)
    finally:
        ray.shutdown()


def run_tasks(
    act: Callable[[Argument], Result],
    arguments: Mapping[str, Argument],
    workers: Workers,
    done: Callable[[str, Result | Exception], object],
    doing: Callable[[str], object],
) -> None:
    """Call a function with each argument in a worker; `done` gets the argument's name and what came of it.

    `doing` gets, about every second, which tasks run and for how long.

    A task whose process ended early `MAX_STARTS` times comes to a WorkerError. What `done` raises, and Ctrl-C, end all.
    """
    waiting, ended, running = deque(arguments), Counter[str](), dict[Any, tuple[str, float]]()
    try:
        while waiting or running:
            while waiting and len(running) < workers.count:
                name = waiting.popleft()
                running[workers.start(act, arguments[name])] = name, time.monotonic()
            longest = islice(running.values(), _NAMED)
            names = ", ".join(f"{name} for {time.monotonic() - begun:.0f} s" for name, begun in longest)
            doing(f"{workers.state} {names}{' and others' * (len(running) > _NAMED)}")
            for task in workers.wait(running):
                name, _ = running.pop(task)
                try:
                    outcome = workers.outcome(task)
                except WorkerError as error:
                    ended[name] += 1
                    if ended[name] < MAX_STARTS:
                        waiting.appendleft(name)
                        continue
                    outcome = error
                done(name, outcome)
    finally:
        workers.stop(running)


def _work(answer: connection.Connection, content: bytes) -> None:
    """Do one task in this process, and answer by its result; end where nobody waits for it any more."""

    def nobody_waits() -> None:
        with suppress(EOFError, OSError):
            answer.recv_bytes()

    # Ctrl-C is the parent's, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, args=(nobody_waits,), daemon=True).start()
    outcome = _outcome(*pickle.loads(content))
    try:
        sent = pickle.dumps(outcome)
        pickle.loads(sent)
    except Exception as error:
        found = f"{type(outcome).__name__}, which cannot be sent from the process that made it ({error})"
        sent = pickle.dumps(WorkerError.expected("a result or an error that can be pickled", got=found, name="worker"))
    answer.send_bytes(sent)


def _outcome(act: Callable[[Argument], Result], argument: Argument) -> Result | Exception:
    """Return what a function returns, or the error that it raises, which keeps its traceback as a note."""
    try:
        return act(argument)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return error


def _ended_early(by: str, otherwise: str) -> WorkerError:
    wanted, advice = "a process that finishes", f"run the command again, {otherwise} if memory ran out"
    return WorkerError.expected(
        wanted, by, got=f"ones that end early, {MAX_STARTS} in turn ({by})", name="worker", advice=advice
    )


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Let processes that are started meanwhile have these environment variables."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _imported_ray(raising: type[AvmsfError]) -> ModuleType:
    # One computer needs no authentication, and no usage is reported.
    os.environ.setdefault("RAY_AUTH_MODE", "disabled")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    with from_extra("scale", "ray", raising=raising, instead="omit --ray"):
        import ray
    return ray
