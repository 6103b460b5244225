"""The server of the page: its routes, on the loopback interface, below a secret address, until Ctrl-C."""

import errno
import json
import os
import signal
import socket
import tempfile
import threading
import traceback
import webbrowser
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from avmsf.errors import AvmsfError, StudioError, lacks_memory
from avmsf.export.web import MEDIA_TYPES
from avmsf.pipeline.config import Preset
from avmsf.studio.capture import read_contact
from avmsf.studio.guard import Guard, new_token, nothing_here, policy_of, read_json_object
from avmsf.studio.opening import Opened
from avmsf.studio.responses import FORESEEN_ERRORS, Answer, error_response, response_to
from avmsf.studio.studio import Studio

PAGE = Path(__file__).parent / "page"
_SOUNDS = tuple(suffix for suffix, kind in MEDIA_TYPES.items() if kind.startswith("audio/"))


def make_app(studio: Studio, announce: Callable[[], None] = lambda: None) -> Starlette:
    """Return the application of a studio, which begins and ends with it; `announce` is called once it has begun."""
    html = (PAGE / "index.html").read_text(encoding="utf-8")
    policy = {"content-security-policy": policy_of(html)}

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await studio.begin()
        announce()
        try:
            yield
        finally:
            await studio.close()

    calls = _Calls(studio)
    routes = [
        _route("GET", "/", lambda request: HTMLResponse(html, headers=policy)),
        _route("GET", "/page/{path:path}", lambda request: _file(PAGE, request)),
        _route("GET", "/manifest.json", lambda request: studio.manifest()),
        _route("GET", "/capture", lambda request: studio.capture()),
        _route("GET", "/revisions/{number:int}/{path:path}", calls.send_shown),
        _route("POST", "/locate", studio.locate, read=Request.body),
        _route("POST", "/edit", studio.edit, read=read_json_object),
        _route("POST", "/lead", calls.lead),
        _route("POST", "/undo", studio.undo, read=read_json_object),
        _route("POST", "/save", studio.save, read=read_json_object, status=201),
        _route("POST", "/capture/check", calls.check_recording),
        _route("POST", "/capture/strikes", calls.add_impact, status=201),
        _route("GET", "/capture/strikes/{path:path}", calls.send_recording),
        _route("PUT", "/capture/strikes/{path:path}", calls.redo_impact),
        _route("DELETE", "/capture/strikes/{path:path}", calls.remove_impact),
        _route("POST", "/reconstruct", lambda request: studio.reconstruct()),
        _route("POST", "/object", lambda request: studio.make_object()),
        _route("GET", "/jobs/{job}/events", calls.send_job_events),
        _route("DELETE", "/jobs/{job}", calls.cancel_job),
        _route("GET", "/{path:path}", calls.send_shown),
    ]
    kinds = (AvmsfError, HTTPException, ClientDisconnect, *FORESEEN_ERRORS, Exception)
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=dict.fromkeys(kinds, _answer_error))
    # It would lead to an address without the token.
    app.router.redirect_slashes = False
    return app


class _Calls:
    """The requests whose values are in their address or their headers."""

    def __init__(self, studio: Studio) -> None:
        self.studio = studio

    def send_shown(self, request: Request) -> Response:
        """A file of a revision, by default of the current one: its table, the object, or the sound of an impact."""
        showcase, path = self.studio.showcase, request.path_params["path"]
        number = request.path_params.get("number")
        files = showcase.current.files if number is None else showcase.files_of(number)
        if path not in files:
            raise nothing_here()
        return Response(files[path], media_type=MEDIA_TYPES[Path(path).suffix])

    async def lead(self, request: Request) -> Any:
        base = request.query_params.get("base", "")
        return await self.studio.lead({"base": _as_number(base)}, await request.body())

    async def check_recording(self, request: Request) -> Any:
        content = await request.body()
        return await self.studio.with_editor(lambda editor: editor.check(content))

    async def add_impact(self, request: Request) -> Any:
        impact, content = read_contact(request.query_params), await request.body()
        return await self.studio.with_editor(lambda editor: editor.add(content, impact))

    def send_recording(self, request: Request) -> Response:
        return _file(self.studio.require_editor().folder, request, only=_SOUNDS)

    async def redo_impact(self, request: Request) -> Any:
        name, match, content = request.path_params["path"], _expected(request), await request.body()
        return await self.studio.with_editor(lambda editor: editor.redo(name, content, match=match))

    async def remove_impact(self, request: Request) -> Any:
        name, match = request.path_params["path"], _expected(request)
        await self.studio.with_editor(lambda editor: editor.remove(name, match=match))
        return {"removed": name}

    def send_job_events(self, request: Request) -> Response:
        """The events of a job, as server-sent events; a page that reconnects gets the events that it has missed."""
        job = self.studio.jobs.named(request.path_params["job"])
        last = _as_number(request.headers.get("last-event-id", ""))
        after = last + 1 if isinstance(last, int) else 0

        async def events() -> AsyncIterator[str]:
            async for number, event in job.listen(after=after):
                yield f"id: {number}\ndata: {json.dumps(event)}\n\n"

        return StreamingResponse(events(), media_type="text/event-stream")

    async def cancel_job(self, request: Request) -> Any:
        """Stop a job, and return whether it was stopped or had ended."""
        job = request.path_params["job"]
        stopped = await self.studio.jobs.named(job).cancel()
        return {"cancelled" if stopped else "ended": job}


def _as_number(text: str) -> int | str:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 10 else text


def _expected(request: Request) -> str | None:
    """Return the digest of the recording that a change is meant for; None where any is."""
    match = request.headers.get("if-match", "*").strip().removeprefix("W/").strip('"')
    return None if match == "*" else match


def _route(
    method: str,
    path: str,
    act: Callable[[Any], Any],
    *,
    read: Callable[[Request], Awaitable[Any]] | None = None,
    status: int = 200,
) -> Route:
    """Return a route of `act`, called with the request or what `read` makes of it; plain values become JSON."""

    async def answer(request: Request) -> Response:
        done = act(request if read is None else await read(request))
        if isinstance(done, Awaitable):
            done = await done
        return done if isinstance(done, Response) else Answer(done, status)

    return Route(path, answer, methods=[method])


def _file(folder: Path, request: Request, *, only: Sequence[str] = tuple(MEDIA_TYPES)) -> Response:
    """Return a file of a folder.

    Raises RequestError (404) for no file, a hidden one, a link out of the folder, and types that the page does not use.
    """
    home = folder.resolve()
    try:
        path = (home / request.path_params["path"]).resolve(strict=True)
        inside = path.is_relative_to(home) and path.is_file()
    except (OSError, ValueError, RuntimeError) as error:
        raise nothing_here() from error
    suffix = path.suffix.lower()
    if not inside or suffix not in only or any(part.startswith(".") for part in path.relative_to(home).parts):
        raise nothing_here()
    return FileResponse(path, media_type=MEDIA_TYPES[suffix])


async def _answer_error(request: Request, error: Exception) -> Response:
    """Answer each error by a sentence and a status: 500 only where it is the server's own fault."""
    if isinstance(error, ClientDisconnect):
        return Response(status_code=499)  # nobody receives it
    if isinstance(error, HTTPException):
        return Answer({"error": f"{request.method}: nothing found at this address"}, error.status_code)
    if isinstance(error, AvmsfError):
        return response_to(error)
    if isinstance(error, FORESEEN_ERRORS) or lacks_memory(error):
        return response_to(error_response(error))
    # The server's own word on it is hidden with all that it says of ordinary requests.
    traceback.print_exception(error)
    words = f"the server failed ({type(error).__name__}); see its terminal, and reload the page for the current state"
    return Answer({"error": words}, 500)


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
    preset: Preset = "default",
) -> None:
    """Serve the page until Ctrl-C; `log` is called with its address.

    Without `port` it is PORT, or a free one if that is in use. Raises StudioError if a given port is in use, and the
    errors of the readers.
    """
    with listen(port) as listener, _temporary_folder() as folder:
        number, token = listener.getsockname()[1], new_token()
        address = f"http://{_HOME}:{number}/{token}/"
        studio = Studio(opened, Path(folder), preset)

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
