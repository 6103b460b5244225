"""The server of the page: on this machine alone, under an address that nobody else knows, until Ctrl-C."""

import errno
import os
import signal
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

import uvicorn

from avmsf.errors import StudioError
from avmsf.studio.guard import Guard, new_token
from avmsf.studio.opening import Opened
from avmsf.studio.routes import make_app
from avmsf.studio.studio import Studio, StudioConfig

PORT = 8634
"""Where the page is without --port, so that a browser remembers what this page may do, such as use the microphone."""
_HOME = "127.0.0.1"
_HANGING = 1
"""Seconds that an answer under way may take when the server ends."""


class PageServer(uvicorn.Server):
    """Says where the page is as soon as it answers."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self.announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen."""
        await super().startup(sockets)
        if not self.should_exit:
            self.announce()


def serve(
    opened: Opened,
    *,
    port: int | None = None,
    browser: bool = True,
    tell: Callable[[str], None],
    config: StudioConfig | None = None,
) -> bool:
    """Serve the page until Ctrl-C; `tell` hears its address. Without `port` PORT, or a free one where that is taken.

    Returns whether a thread still computes what nobody waits for any more. Raises StudioError where a given port is
    taken, and as the readers of what is opened do.
    """
    with _listening(port) as listener, tempfile.TemporaryDirectory(prefix="avmsf-studio-") as folder:
        number, token = listener.getsockname()[1], new_token()
        address = f"http://{_HOME}:{number}/{token}/"
        studio = Studio(opened, Path(folder), config)
        guarded = Guard(make_app(studio), token=token, port=number)

        def announce() -> None:
            tell(address)
            if browser:
                _open_browser(address, Path(folder))

        server = PageServer(
            uvicorn.Config(
                guarded,
                log_level="critical",
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=_HANGING,
            ),
            announce,
        )
        before = signal.signal(signal.SIGTERM, _interrupt)
        try:
            # The server has ended in order before it passes Ctrl-C on.
            with suppress(KeyboardInterrupt):
                server.run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, before)
        return studio.busy


def _open_browser(address: str, folder: Path) -> None:
    """Open the page by way of a file that only its owner reads: everybody reads a browser's command line."""
    path = folder / "open.html"
    with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w", encoding="utf-8") as file:
        file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}" />\n')
    # Browsers of the terminal stay until they are left.
    threading.Thread(target=webbrowser.open, args=(path.as_uri(),), daemon=True).start()


def _listening(port: int | None) -> socket.socket:
    """Return a socket bound on this machine. Raises StudioError for a port that is taken or forbidden."""
    for number in (PORT, 0) if port is None else (port,):
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        # Without it a port would stay taken for a minute after the server before.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((_HOME, number))
            listener.listen()
            return listener
        except OSError as error:
            listener.close()
            if error.errno == errno.EADDRINUSE and number == PORT and port is None:
                continue
            why = "taken by another program" if error.errno == errno.EADDRINUSE else error.strerror
            raise StudioError(
                f"port {number}: expected a free one, found it {why}: leave --port out, or give --port 0 for any that "
                "is free"
            ) from error
        except OverflowError as error:
            listener.close()
            raise StudioError(f"port {number}: expected 0 to 65535, found another: leave --port out") from error
    raise AssertionError("a port that is asked for by 0 is free")


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
