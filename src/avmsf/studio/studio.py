"""The state of one server, and the operations that the page requests: no HTTP, nothing that blocks the event loop."""

import tempfile
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from avmsf.editing.modal_edit import EDITS, remarks
from avmsf.fem.material import MATERIALS
from avmsf.field.store import load, save
from avmsf.pipeline.config import Preset
from avmsf.studio.capture import CaptureEditor, read_upload
from avmsf.studio.edit import OLD_MATERIAL, Sliders
from avmsf.studio.files import Showcase
from avmsf.studio.jobs import Event, Jobs, Result, Threads
from avmsf.studio.locate import Searches
from avmsf.studio.opening import Opened, shows_more
from avmsf.studio.responses import NUMERIC_ERRORS, bad_request, error_response
from avmsf.studio.session import Revision, Session

_STEPS = 150
"""Steps towards a recording: half of the command line's, after which little changes."""


class Studio:
    """What is open. Its coroutines run on one event loop; what takes long runs in threads or in a job."""

    def __init__(self, opened: Opened, folder: Path, preset: Preset = "default") -> None:
        """Open everything; `folder` is for files that end with the server, `preset` the settings of reconstructions.

        Raises as the readers do.
        """
        self.opened, self.folder, self.preset = opened, folder, preset
        self.editor = None if opened.capture is None else CaptureEditor(opened.capture)
        self.showcase = Showcase(opened, self.editor)
        self.session = Session(opened.home, self.showcase.show)
        self.jobs = Jobs()
        self.threads = Threads()
        self.searches = Searches(self.session, self.showcase, self.editor, self.threads)
        self.session.open(None if opened.field is None else load(opened.field))

    async def begin(self) -> None:
        """Start what can be done ahead of time."""
        self.searches.prepare_ahead()
        if shows_more(self.opened):
            await self.make_object()

    async def close(self) -> None:
        """Stop what runs."""
        self.searches.close()
        await self.jobs.close()

    async def locate(self, content: bytes) -> dict[str, Any]:
        """Return the positions of a recording's impacts on the current revision. Raises LocationError, CaptureError."""
        recording = await self.threads.run("read", read_upload, content)
        revision = self.session.current
        impacts = await self._compute(self.searches.finder_of(revision).locate, recording)
        return {"revision": revision.number, "impacts": impacts}

    async def edit(self, request: dict[str, Any]) -> dict[str, Any]:
        """Set the sliders. Raises the errors of edits."""
        base = base_of(request)
        sliders = Sliders.read(request, modes=len(self.session.current.require_field().bank))
        return self._changed(await self._compute(self.session.edit, base, sliders))

    async def lead(self, request: dict[str, Any], content: bytes) -> dict[str, Any]:
        """Start to optimize the field towards a recording. Raises CaptureError for one that cannot be used."""
        base = base_of(request)
        await self.threads.run("read", read_upload, content)
        self.session.check_current(base)
        field = self.session.current.require_field()
        self.jobs.check_idle()
        folder = Path(tempfile.mkdtemp(prefix="lead-", dir=self.folder))
        (folder / "like.wav").write_bytes(content)
        await self.threads.run("compute", save, field, folder / "field")
        files = {"field": "field", "recording": "like.wav", "output": "led"}
        task: Event = {"task": "lead", "steps": _STEPS}
        task |= {name: str(folder / file) for name, file in files.items()}
        return {"job": self.jobs.start("the guided edit", task, partial(self._take_led, base)).identifier}

    async def undo(self, request: dict[str, Any]) -> dict[str, Any]:
        """Go back by one revision."""
        return self._changed(await self.threads.run("compute", self.session.undo, base_of(request)))

    async def save(self, request: dict[str, Any]) -> dict[str, Any]:
        """Write the field to a new file."""
        name = request.get("name")
        if not isinstance(name, str):
            raise bad_request("name", "the new file's name", name)
        path, revision = await self.threads.run("compute", self.session.save, base_of(request), name)
        return {"file": str(path), **self._changed(revision)}

    async def capture(self) -> dict[str, Any]:
        """Return the impacts of the capture."""
        return await self.threads.run("read", self.require_editor().describe)

    async def with_editor(self, act: Callable[[CaptureEditor], Result]) -> Result:
        """Change the capture's impacts, one request after another. Raises RequestError (404) without a capture."""
        return await self.threads.run("write", act, self.require_editor())

    def require_editor(self) -> CaptureEditor:
        """Return the capture's impacts. Raises RequestError: 404 without a capture, 503 while its folder is missing."""
        if self.editor is None:
            advice = "start avmsf studio with --capture"
            raise bad_request("capture", "a folder", got="only a field", advice=advice, status=404)
        if not self.editor.folder.is_dir():
            # Not 4xx: the page keeps a recording and sends it again.
            folder, advice = self.editor.folder, "restore it and try again"
            raise bad_request("capture", "the capture folder", got="none", advice=advice, status=503, file=folder)
        return self.editor

    async def reconstruct(self) -> dict[str, Any]:
        """Start to fit a field to the capture, which becomes the current one."""
        editor = self.require_editor()
        if not any(impact["digest"] for impact in await self.threads.run("read", editor.impacts)):
            raise bad_request("recordings", "one or more", 0, advice="record impacts first", status=409)
        # One output is enough: the next job starts when this one's field is open.
        output = str(self.folder / "reconstructed")
        task = {"task": "make_field", "folder": str(editor.folder), "output": output, "preset": self.preset}
        return {"job": self.jobs.start("the reconstruction", task, self._take_field).identifier}

    async def make_object(self) -> dict[str, Any]:
        """Begin to make Gaussians of the capture's pictures, to have something to click."""
        task = {"task": "make_object", "folder": str(self.require_editor().folder)}
        return {"job": self.jobs.start("the reconstruction from the images", task, self._take_object).identifier}

    async def _compute(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Compute with a user's values. Raises RequestError (422) if they give no result."""
        try:
            return await self.threads.run("compute", act, *arguments)
        except NUMERIC_ERRORS as error:
            # A check of the values that would name the cause is missing.
            traceback.print_exception(error)
            raise error_response(error) from error

    async def _take_field(self, result: Event) -> Event:
        revision = await self.threads.run("compute", lambda: self.session.open(load(result["output"])))
        return {**result, **self._changed(revision)}

    async def _take_object(self, result: Event) -> Event:
        current = self.session.current
        if current.field is None:
            current = await self.threads.run("compute", self.session.open, None)
        return {**result, **self._changed(current)}

    async def _take_led(self, base: int, result: Event) -> Event:
        def take() -> Revision:
            led = load(result["output"])
            notes = remarks(led.origin.report[EDITS][-1:], led)
            if base != self.session.current.number:
                notes.append("the field was changed while the guided edit ran: undo takes back the guided edit alone")
            return self.session.lead(led, tuple(notes))

        return self._changed(await self.threads.run("compute", take))

    def _changed(self, revision: Revision) -> dict[str, Any]:
        """Return what the page gets for a new revision."""
        self.searches.prepare_ahead()
        return {"revision": revision.number, "remarks": list(revision.remarks)}

    def manifest(self) -> dict[str, Any]:
        """Return the manifest of the current revision, with what this server can do."""
        shown, running, abilities = self.showcase.current, self.jobs.current, list[str]()
        revision, field = shown.revision, shown.revision.field
        if field is not None:
            abilities += ["locate", "edit", "save", "like"]
        if self.editor is not None:
            abilities += ["capture", "reconstruct"]
        live = {
            "revision": revision.number,
            "undo": self.session.can_undo,
            "abilities": abilities,
            "mode": "capture" if field is None else "field",
            "sliders": revision.sliders.to_json(),
            "remarks": [*shown.remarks, *revision.remarks],
            "rows": [] if field is None else field.audible.nonzero().flatten().tolist(),
            "materials": list(MATERIALS),
            "oldMaterial": OLD_MATERIAL,
            "folder": None if self.editor is None else str(self.editor.folder),
            "job": None if running is None else running.identifier,
            "jobKind": None if running is None else running.kind,
            "noObject": self.jobs.failure("make_object"),
        }
        return {**shown.manifest, "live": live}


def base_of(request: dict[str, Any]) -> int:
    """Return the revision that a change is based on. Raises RequestError (400) if the request has none."""
    base = request.get("base")
    if not isinstance(base, int) or isinstance(base, bool):
        raise bad_request("base", "the number of a revision", base, advice="reload the page")
    return base
