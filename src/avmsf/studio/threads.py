"""What would block the event loop, in threads: one at a time of each kind, and counted where it takes long."""

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, TypeVar

import anyio
import anyio.to_thread

Result = TypeVar("Result")


class Threads:
    """The threads of one server; each kind waits for its own, so that recordings are taken in while a search runs."""

    def __init__(self) -> None:
        self._computing, self._preparing = anyio.CapacityLimiter(1), anyio.CapacityLimiter(1)
        self._writing, self._reading = anyio.CapacityLimiter(1), anyio.CapacityLimiter(1)
        self._busy, self._lock = 0, Lock()

    @property
    def busy(self) -> bool:
        """Whether a thread is computing, which cannot be interrupted."""
        return self._busy > 0

    async def compute(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Do what a page waits for, one edit or search after another."""
        return await anyio.to_thread.run_sync(partial(self._counted, act, *arguments), limiter=self._computing)

    async def compute_ahead(self, act: Callable[[], Result]) -> Result:
        """Compute in the background a result that is not needed yet."""
        return await anyio.to_thread.run_sync(partial(self._counted, act), limiter=self._preparing)

    async def write(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Change files."""
        return await anyio.to_thread.run_sync(partial(act, *arguments), limiter=self._writing)

    async def read(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Read files in a thread."""
        return await anyio.to_thread.run_sync(partial(act, *arguments), limiter=self._reading)

    def _counted(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Do something that may outlive the server."""
        with self._lock:
            self._busy += 1
        try:
            return act(*arguments)
        finally:
            with self._lock:
                self._busy -= 1
