"""Time and memory of a piece of work, and work in a process of its own, whose memory is its own."""

import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

_Result = TypeVar("_Result")


def apart(function: Callable[..., _Result], *arguments: object) -> _Result:
    """Return what a function of a module returns in a fresh process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def timed(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """Return what the work returns and the seconds that it takes."""
    begun = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begun


def peak_gigabytes() -> float:
    """Return the most memory that this process has held, 10^9 bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # On Linux a new process's ru_maxrss begins at its parent's peak; the high-water mark is its own.
        mark = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(mark.split()[1]) * 1024 / 1e9
    # macOS counts in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e9


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it started and that have ended."""
    own, others = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime
