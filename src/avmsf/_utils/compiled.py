"""Loops compiled for the processor, kept from one run to the next where that is possible, and run on several cores."""

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from pathlib import Path
from typing import Any

_CACHE_BYTES = 50_000_000
"""Several times what all compiled loops take."""
MAX_LANES = 8
"""Most threads that one kernel runs on: with more, handing out the work costs what they save (kernels take ms)."""


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call, by numba's `options`; it releases the GIL.

    What was compiled is kept beside the package, or in the user's cache, so that later runs load it. Where neither
    folder may be written to, as in a container without a home, or its disk is full, every run compiles again:
    `NUMBA_CACHE_DIR` names another.
    """

    options.setdefault("nogil", True)
    return lambda function: _Compiled(function, options)


class _Compiled:
    """A function that numba compiles; importing numba takes as long as much of what needs no loop."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.function, self.options = function, options

    def __call__(self, *arguments: Any) -> Any:
        return self.made(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Return what numba's own function has, by which other compiled functions call it."""
        return getattr(self.made, name)

    @cached_property
    def made(self) -> Callable[..., Any]:
        import numba

        try:
            made: Callable[..., Any] = numba.njit(cache=_has_space(), **self.options)(self.function)
        except RuntimeError:
            # Numba looks for a folder at once, and raises this where it finds none.
            made = numba.njit(**self.options)(self.function)
        return made


def _has_space() -> bool:
    """Return whether the disk of the cache has room for all that is compiled: numba raises where it is full."""
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or __file__)
    existing = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    return shutil.disk_usage(existing).free > _CACHE_BYTES


def lane_count() -> int:
    """Return how many threads a kernel runs on: as many as numba is given, `NUMBA_NUM_THREADS`, up to `MAX_LANES`."""
    import numba
    import torch

    threads = torch.get_num_threads()
    count = numba.get_num_threads()
    # Its first call starts OpenMP with all cores, and torch may share that.
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
    return min(count, MAX_LANES)


def run_lanes(kernel: Callable[..., Any], lanes: int, *arguments: Any) -> None:
    """Call a compiled `kernel(lane, lanes, *arguments)` for each lane, side by side, and wait for all.

    Numba's own `parallel=True` doubles the time that a kernel takes to compile.
    """
    others = [_pool().submit(kernel, lane, lanes, *arguments) for lane in range(1, lanes)]
    try:
        kernel(0, lanes, *arguments)
    finally:
        for each in others:
            each.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MAX_LANES - 1, thread_name_prefix="avmsf-lane")


if hasattr(os, "register_at_fork"):
    # Threads do not outlive a fork.
    os.register_at_fork(after_in_child=_pool.cache_clear)
