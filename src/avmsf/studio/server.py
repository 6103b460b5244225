"""The server of the page: on the loopback interface, at a secret address, until Ctrl-C."""

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
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from avmsf.errors import StudioError
from avmsf.studio.guard import Guard, new_token
from avmsf.studio.opening import Opened
from avmsf.studio.routes import make_app
from avmsf.studio.studio import Studio, StudioConfig

PORT = 8634
"""Where the page is without --port, so that a browser remembers what this page may do, such as use the microphone."""
_HOME = "127.0.0.1"


def make_server(app: ASGIApp) -> uvicorn.Server:
    """Return a server that prints nothing."""
    silent: Any = {"log_level": "critical", "access_log": False, "server_header": False}
    return uvicorn.Server(uvicorn.Config(app, ws="none", timeout_graceful_shutdown=1, **silent))


def serve(
    opened: Opened,
    *,
    port: int | None = None,
    browser: bool = True,
    log: Callable[[str], None],
    config: StudioConfig | None = None,
) -> None:
    """Serve the page until Ctrl-C; `log` is called with its address.

    Without `port` it is PORT, or a free one if that is in use. Raises StudioError if a given port is in use, and the
    errors of the readers.
    """
    with listen(port) as listener, _temporary_folder() as folder:
        number, token = listener.getsockname()[1], new_token()
        address = f"http://{_HOME}:{number}/{token}/"
        studio = Studio(opened, Path(folder), config)

        def announce() -> None:
            log(address)
            if browser:
                # A browser that cannot be opened is no failure: the address is printed.
                with suppress(OSError):
                    _open_browser(address, Path(folder))

        server = make_server(Guard(make_app(studio, announce), token=token, port=number))
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            # The server has ended in order before it passes Ctrl-C on.
            with suppress(KeyboardInterrupt):
                server.run(sockets=[listener])
        finally:
            signal.signal(signal.SIGTERM, before)


def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Return a folder that is removed with the server. Raises StudioError where none can be made."""
    try:
        return tempfile.TemporaryDirectory(prefix="avmsf-studio-")
    except OSError as error:
        reason, advice = error.strerror or str(error), "free some space, or set this environment variable"
        raise StudioError.expected("a temporary folder", reason, name="TMPDIR", advice=advice) from error


def _open_browser(address: str, folder: Path) -> None:
    """Open the page by a file that only its owner can read: the command line of a browser is public."""
    path = folder / "open.html"
    with open(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w", encoding="utf-8") as file:
        file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}" />\n')
    # Browsers of the terminal stay until they are left.
    threading.Thread(target=webbrowser.open, args=(path.as_uri(),), daemon=True).start()


def listen(port: int | None) -> socket.socket:
    """Return a socket bound on this machine, by default at PORT or a free port.

    Raises StudioError for a given port that is taken or forbidden.
    """
    number = PORT if port is None else port
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    # Without it a port would stay taken for a minute after the server before.
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((_HOME, number))
        listener.listen()
        return listener
    except (OSError, OverflowError) as error:
        listener.close()
        if port is None and isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            return listen(0)
        advice = "leave --port out, or give --port 0 for any free one"
        wanted, got = "a free one from 0 to 65535", f"{error} at {number}"
        raise StudioError.expected(wanted, number, got=got, name="port", advice=advice) from error
