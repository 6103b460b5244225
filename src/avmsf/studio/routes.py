"""The routes below the server's secret address, one for each request of the page."""

import json
import traceback
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, Response, StreamingResponse
from starlette.routing import Route

from avmsf.errors import AvmsfError, lacks_memory
from avmsf.export.web import MEDIA_TYPES
from avmsf.studio.capture import Contact
from avmsf.studio.guard import contained, nothing_here, policy_of, read_json_object
from avmsf.studio.responses import FORESEEN_ERRORS, Answer, error_response, response_to
from avmsf.studio.studio import Studio, unknown_base

PAGE = Path(__file__).parent / "page"
_SOUNDS = tuple(suffix for suffix, kind in MEDIA_TYPES.items() if kind.startswith("audio/"))
_GONE = 499
"""Response to a page that has disconnected."""
Handler = Callable[[Request], Awaitable[Response]]


def make_app(studio: Studio) -> Starlette:
    """Return the application of a studio, which begins and ends with it."""
    html = (PAGE / "index.html").read_text(encoding="utf-8")
    policy = {"content-security-policy": policy_of(html)}

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        await studio.begin()
        try:
            yield
        finally:
            await studio.close()

    async def show_page(request: Request) -> Response:
        return HTMLResponse(html, headers=policy)

    calls = Calls(studio)
    routes = [
        _get("/", show_page),
        _get("/page/{path:path}", partial(_send_from, PAGE)),
        _get("/manifest.json", calls.send_manifest),
        _get("/revisions/{number:int}/{path}", calls.send_revision),
        _get("/{path}", calls.send_shown),
        _get("/strikes/{path}", calls.send_measured),
        Route("/locate", calls.locate, methods=["POST"]),
        Route("/edit", calls.edit, methods=["POST"]),
        Route("/lead", calls.lead, methods=["POST"]),
        Route("/undo", calls.undo, methods=["POST"]),
        Route("/save", calls.save, methods=["POST"]),
        Route("/capture/check", calls.check, methods=["POST"]),
        Route("/capture/strikes", calls.add_impact, methods=["POST"]),
        Route("/capture/strikes/{path:path}", calls.change_impact, methods=["GET", "PUT", "DELETE"]),
        Route("/reconstruct", calls.reconstruct, methods=["POST"]),
        Route("/object", calls.make_object, methods=["POST"]),
        _get("/jobs/{job}/events", calls.send_job_events),
        Route("/jobs/{job}", calls.cancel_job, methods=["DELETE"]),
    ]
    app = Starlette(
        routes=routes,
        lifespan=lifespan,
        exception_handlers={
            AvmsfError: _answer_error,
            HTTPException: _answer_unknown,
            ClientDisconnect: _answer_nobody,
            **dict.fromkeys(FORESEEN_ERRORS, _answer_foreseen),
            Exception: _answer_broken,
        },
    )
    # It would lead to an address without the token.
    app.router.redirect_slashes = False
    return app


class Calls:
    """What the page can ask of a studio."""

    def __init__(self, studio: Studio) -> None:
        self.studio = studio

    async def send_manifest(self, request: Request) -> Response:
        """What is shown, and what the server can do."""
        return Answer(self.studio.manifest())

    async def send_revision(self, request: Request) -> Response:
        """A file of a revision."""
        return _file(self.studio.showcase.files_of(request.path_params["number"]), request)

    async def send_shown(self, request: Request) -> Response:
        """The table of the current revision, or a file that shows the object; and what the capture holds."""
        name = request.path_params["path"]
        if name == "capture":
            return Answer(await self.studio.capture())
        showcase = self.studio.showcase
        return _file(
            showcase.object_folder if name.startswith(("object.", "surface.")) else showcase.current.folder, request
        )

    async def send_measured(self, request: Request) -> Response:
        """The sound of a recorded impact, as the capture reads it."""
        return _file(self.studio.showcase.object_folder / "strikes", request)

    async def locate(self, request: Request) -> Response:
        """Locate the impact of a recording."""
        return Answer(await self.studio.locate(await request.body()))

    async def edit(self, request: Request) -> Response:
        """Change the field."""
        done = await self.studio.edit(await read_json_object(request))
        return Answer(done, 202 if "job" in done else 200)

    async def lead(self, request: Request) -> Response:
        """Optimize the sound towards a recording."""
        base = request.query_params.get("base", "")
        if not (base.isascii() and base.isdigit() and len(base) < 10):
            raise unknown_base(base)
        return Answer(await self.studio.lead(int(base), await request.body()), 202)

    async def undo(self, request: Request) -> Response:
        """Take a change back."""
        return Answer(await self.studio.undo(await read_json_object(request)))

    async def save(self, request: Request) -> Response:
        """Write the field to a file."""
        return Answer(await self.studio.save(await read_json_object(request)), 201)

    async def check(self, request: Request) -> Response:
        """Check a recording without saving it."""
        content = await request.body()
        return Answer(await self.studio.with_editor(lambda editor: editor.check(content)))

    async def add_impact(self, request: Request) -> Response:
        """Add an impact to the capture."""
        contact, content = Contact.read(request.query_params), await request.body()
        return Answer(await self.studio.with_editor(lambda editor: editor.add(content, contact)), 201)

    async def change_impact(self, request: Request) -> Response:
        """Send, redo or take out one of the capture's recordings."""
        name = request.path_params["path"]
        match = _expected(request)
        if request.method == "DELETE":
            await self.studio.with_editor(lambda editor: editor.remove(name, match=match))
            return Answer({"removed": name})
        if request.method == "PUT":
            content = await request.body()
            return Answer(await self.studio.with_editor(lambda editor: editor.redo(name, content, match=match)))
        return _file(self.studio.require_editor().folder, request, only=_SOUNDS)

    async def reconstruct(self, request: Request) -> Response:
        """Make a field of the capture."""
        return Answer({"job": (await self.studio.reconstruct()).identifier}, 202)

    async def make_object(self, request: Request) -> Response:
        """Make something to click of the capture's pictures, once more where that has failed."""
        return Answer({"job": self.studio.make_object().identifier}, 202)

    async def send_job_events(self, request: Request) -> Response:
        """The events of a job, as server-sent events; a page that reconnects gets the events that it has missed."""
        job = self.studio.jobs.named(request.path_params["job"])
        last = request.headers.get("last-event-id", "")
        after = int(last) + 1 if last.isdigit() and len(last) < 10 else 0

        async def events() -> AsyncIterator[str]:
            async for number, event in job.listen(after=after):
                yield f"id: {number}\ndata: {json.dumps(event)}\n\n"

        return StreamingResponse(events(), media_type="text/event-stream")

    async def cancel_job(self, request: Request) -> Response:
        """Stop a job, and return whether it was stopped or had ended."""
        job = request.path_params["job"]
        stopped = await self.studio.jobs.named(job).cancel()
        return Answer({"cancelled" if stopped else "ended": job})


def _expected(request: Request) -> str | None:
    """Return the digest of the recording that a change is meant for; None where any is."""
    match = request.headers.get("if-match", "*").strip().removeprefix("W/").strip('"')
    return None if match == "*" else match


def _get(path: str, handler: Handler) -> Route:
    async def answer(request: Request) -> Response:
        return await handler(request)

    return Route(path, answer, methods=["GET"])


async def _send_from(folder: Path, request: Request) -> Response:
    return _file(folder, request)


def _file(folder: Path, request: Request, *, only: Sequence[str] = ()) -> Response:
    """Return a file of a folder. Raises RequestError (404) for media types that the page does not use."""
    path = contained(folder, request.path_params["path"])
    kind = MEDIA_TYPES.get(path.suffix.lower())
    hidden = any(part.startswith(".") for part in path.relative_to(folder.resolve()).parts)
    if kind is None or hidden or (only and path.suffix.lower() not in only):
        raise nothing_here()
    return FileResponse(path, media_type=kind)


async def _answer_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, AvmsfError)
    return response_to(error)


async def _answer_unknown(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return Answer({"error": f"{request.method}: nothing found at this address"}, error.status_code)


async def _answer_nobody(request: Request, error: Exception) -> Response:
    return Response(status_code=_GONE)


async def _answer_foreseen(request: Request, error: Exception) -> Response:
    return response_to(error_response(error))


async def _answer_broken(request: Request, error: Exception) -> Response:
    if lacks_memory(error):
        return response_to(error_response(error))
    # The server's own word on it is hidden with all that it says of ordinary requests.
    traceback.print_exception(error)
    words = f"the server failed ({type(error).__name__}); see its terminal, and reload the page for the current state"
    return Answer({"error": words}, 500)
