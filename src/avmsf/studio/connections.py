"""Limits on connections, which anybody on this machine can open without knowing the studio's secret.

A connection counts as idle while no request of it is being answered: before its first request is complete, and from the
end of an answer to the next complete request. Idle connections are closed after `IDLE_SECONDS`, and the one that has
been idle longest is closed where there are too many. What is being answered is left alone: only requests with the
secret take long.
"""

import asyncio
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

IDLE_SECONDS = 10.0
"""How long a connection may take to send the head of a request.

A browser on this machine sends it within milliseconds, and opens another connection where an idle one was closed.
Servers of slow networks allow 20 s to 60 s (Apache, Node.js, nginx).
"""
MAX_CONNECTIONS = 256
"""Open at once: a browser opens six for all tabs of a page."""
BACKLOG = 16
"""Connections that the system accepts ahead, and that the event loop takes in one step, before it can close others."""
_LEAST_CONNECTIONS = 16
"""Kept open whatever the limit of files is: twice the six of a browser, and some for whoever does not know the
secret."""
_SPARED_FILES = 64
"""File descriptors left to the rest of the program, and to `BACKLOG` connections that wait to be counted. Fewer are
left where the process may open less than `_SPARED_FILES + 2 * _LEAST_CONNECTIONS` (96): no system's default is that
low."""


def max_connections() -> int:
    """Return how many connections this process can keep open, `MAX_CONNECTIONS` at most."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return MAX_CONNECTIONS
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files == resource.RLIM_INFINITY:
        return MAX_CONNECTIONS
    # Two for each: a connection may be sending a file.
    return max(_LEAST_CONNECTIONS, min(MAX_CONNECTIONS, (files - _SPARED_FILES) // 2))


def limited(app: Any, **options: Any) -> uvicorn.Config:
    """Return the configuration of a server whose connections are limited."""
    most = max_connections()

    class Limited(LimitedProtocol):
        max_connections = most

    return uvicorn.Config(
        app,
        http=Limited,
        ws="none",
        backlog=BACKLOG,
        # Also counts requests whose client has hung up while they are answered.
        limit_concurrency=most + 1,
        log_level="critical",
        access_log=False,
        server_header=False,
        **options,
    )


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 that closes idle connections."""

    max_connections = MAX_CONNECTIONS
    _idle_since: float | None = None
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, and close the connection that was idle longest where there are too many."""
        super().connection_made(transport)
        self._watch()
        if len(self.connections) > self.max_connections:
            idle = [each for each in self.connections if getattr(each, "_idle_since", None) is not None]
            min(idle, key=lambda each: each._idle_since)._close()  # type: ignore[union-attr]

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._unwatch()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read on."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Begin to wait for the next request."""
        super().on_response_complete()
        self._unwatch()
        self._watch()

    def _watch(self) -> None:
        """Start the timeout of an idle connection."""
        if self.cycle is not None and not self.cycle.response_complete:
            self._unwatch()
        elif self._idle_since is None and not self.transport.is_closing():
            self._idle_since = self.loop.time()
            self._timer = self.loop.call_later(IDLE_SECONDS, self._close)

    def _unwatch(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._idle_since = None

    def _close(self) -> None:
        self._unwatch()
        self.connections.discard(self)
        # Not abort(): the end of an answer may wait to be read.
        self.transport.close()
