"""All that one server has open, and what it does when the page asks: nothing of HTTP, nothing that blocks the loop."""

import asyncio
import base64
import binascii
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import anyio
import anyio.to_thread

from avmsf.capture.together import refuse_few
from avmsf.errors import CaptureError, EditError
from avmsf.field.store import load, save
from avmsf.studio.capturing import StrikeBook
from avmsf.studio.editing import MATERIAL_NAMES, Sliders
from avmsf.studio.jobs import Event, Job, Jobs
from avmsf.studio.locating import Finder, read_upload
from avmsf.studio.opening import Opened, find_object, shows_more
from avmsf.studio.refusal import RefusedError
from avmsf.studio.sampling import length_of
from avmsf.studio.session import Revision, Session
from avmsf.studio.showing import Showcase
from avmsf.tasks.edits import EDITS, remarks
from avmsf.tasks.stableaudiofiles import STABLE_AUDIO

Result = TypeVar("Result")
MODES = 128
"""Most modes that a reconstruction keeps."""
STEER_STEPS = 150
"""Steps of a descent in the page: half of the command line's, after which little changes."""
_SETTLED = 0.5
"""Seconds that a revision stays the last one before its tables are made: sliders are dragged."""


@dataclass(frozen=True)
class StudioConfig:
    """What the page is offered beside what is opened."""

    model: str | None = None
    """Folder or name of a Stable Audio pipeline for edits by words; that of the hub's cache where there is one."""
    modes: int = MODES
    steps: int = STEER_STEPS


class Studio:
    """What is open. Its coroutines run on one event loop; what takes long runs in threads or in a job."""

    def __init__(self, opened: Opened, folder: Path, config: StudioConfig | None = None) -> None:
        """Open everything; `folder` is for files that end with the server. Raises as the readers do."""
        self.opened, self.folder = opened, folder
        self.config = StudioConfig() if config is None else config
        self.book = None if opened.capture is None else StrikeBook(opened.capture)
        self.showcase = Showcase(opened, folder, self.book)
        self.session = Session(opened.home, self.showcase.show)
        self.jobs = Jobs()
        self.model = words_model(self.config.model)
        self._finder: tuple[int, Finder] | None = None
        self._ahead: asyncio.Task[None] | None = None
        self._busy, self._threads = 0, Lock()
        # One edit, one search at a time; recordings are taken in meanwhile.
        self._computing, self._writing = anyio.CapacityLimiter(1), anyio.CapacityLimiter(1)
        self.session.open(None if opened.field is None else load(opened.field))

    @property
    def busy(self) -> bool:
        """Whether a thread computes, which nothing can interrupt."""
        return self._busy > 0

    async def begin(self) -> None:
        """Start what can be done ahead of time."""
        self._prepare_ahead()
        if shows_more(self.opened):
            self.make_object()

    async def close(self) -> None:
        """Stop what runs."""
        if self._ahead is not None:
            self._ahead.cancel()
        await self.jobs.close()

    def manifest(self) -> dict[str, Any]:
        """Return the manifest of the current revision, with what this server can do."""
        shown = self.showcase.current
        return {**shown.manifest, "live": self._live(shown.revision)}

    async def locate(self, content: bytes) -> dict[str, Any]:
        """Return where the blows of a recording fell on the current revision. Raises LocationError, CaptureError."""
        recording = await self._written(read_upload, content)
        revision = self.session.current
        finder = self._finder_of(revision)
        blows = await self._computed(finder.locate, recording)
        return {"revision": revision.number, "blows": blows}

    async def edit(self, words: dict[str, Any]) -> dict[str, Any]:
        """Set the sliders, or start to lead the field towards a recording or words. Raises as edits do."""
        base = base_of(words)
        if words.get("like") is not None or words.get("prompt") is not None:
            return await self._lead(base, words)
        sliders = Sliders.read(words)
        return self._changed(await self._computed(self.session.edit, base, sliders))

    async def undo(self, words: dict[str, Any]) -> dict[str, Any]:
        """Go back by one revision."""
        return self._changed(await self._computed(self.session.undo, base_of(words)))

    async def save(self, words: dict[str, Any]) -> dict[str, Any]:
        """Write the field to a new file."""
        name = words.get("name")
        if not isinstance(name, str):
            raise RefusedError(400, f'"name": expected the new file\'s name, found {name!r}')
        path, revision = await self._computed(self.session.save, base_of(words), name)
        return {"file": str(path), **self._changed(revision)}

    async def capture(self) -> dict[str, Any]:
        """Return the capture's strikes, and what shows its object."""
        book = self.expect_book()
        shown = find_object(self.opened)
        running = self.jobs.current
        return {
            **await self._written(book.describe),
            "object": None if shown is None else shown.name,
            "job": None if running is None else running.identifier,
        }

    async def with_book(self, act: Callable[[StrikeBook], Result]) -> Result:
        """Do something with the capture's strikes, one after another. Raises RefusedError (404) without a capture."""
        return await self._written(act, self.expect_book())

    def expect_book(self) -> StrikeBook:
        """Return the capture's strikes. Raises RefusedError (404) without a capture."""
        if self.book is None:
            raise RefusedError(404, "expected a capture folder, found a field alone: start avmsf studio with --capture")
        return self.book

    async def reconstruct(self) -> Job:
        """Begin to make a field of the capture, which is heard when it is done."""
        book = self.expect_book()
        strikes = await self._written(book.strikes)
        try:
            refuse_few(len(strikes))
        except CaptureError as error:
            raise RefusedError(409, f"{error}: strike more places first") from error
        task = {"task": "make_field", "folder": str(book.folder), "modes": self.config.modes}
        return self.jobs.start("reconstruct", task, self._take_field)

    def make_object(self) -> Job:
        """Begin to make Gaussians of the capture's pictures, to have something to click."""
        book = self.expect_book()
        task = {"task": "make_object", "folder": str(book.folder)}
        return self.jobs.start("make the object of its pictures", task, self._take_object)

    async def _lead(self, base: int, words: dict[str, Any]) -> dict[str, Any]:
        self.session.expect_current(base)
        field = self.session.current.expect_field()
        place = Path(tempfile.mkdtemp(prefix="lead-", dir=self.folder))
        task: Event = {"task": "lead", "field": str(place / "field"), "output": str(place / "led")}
        task["steps"] = self.config.steps
        if words.get("prompt") is not None:
            if self.model is None:
                raise EditError(
                    "editing by words needs the extra and the model: pip install 'avmsf[text]' and start avmsf studio "
                    "with --model FOLDER"
                )
            prompt = words["prompt"]
            if not isinstance(prompt, str) or not prompt.strip():
                raise RefusedError(400, 'prompt: expected a description such as "a wooden bowl is hit", found none')
            task |= {"prompt": prompt, "model": self.model}
        else:
            recording = _unpacked(words["like"])
            await self._written(read_upload, recording)
            (place / "like.wav").write_bytes(recording)
            task["recording"] = str(place / "like.wav")
        await self._computed(save, field, place / "field")
        return {"job": self.jobs.start("lead the sound", task, partial(self._take_led, base)).identifier}

    async def _take_field(self, result: Event) -> Event:
        path = Path(result["field"])
        revision = await self._computed(lambda: self.session.open(load(path)))
        return {**result, **self._changed(revision)}

    async def _take_object(self, result: Event) -> Event:
        current = self.session.current
        if current.field is None:
            current = await self._computed(self.session.open, None)
        return {**result, **self._changed(current)}

    async def _take_led(self, base: int, result: Event) -> Event:
        def take() -> Revision:
            led = load(result["output"])
            return self.session.lead(base, led, tuple(remarks(led.origin.report[EDITS][-1:], led)))

        return self._changed(await self._computed(take))

    def _changed(self, revision: Revision) -> dict[str, Any]:
        """Return what a page is told of a new revision."""
        self._prepare_ahead()
        return {"revision": revision.number, "remarks": list(revision.remarks)}

    def _finder_of(self, revision: Revision) -> Finder:
        if self._finder is None or self._finder[0] != revision.number:
            field = revision.expect_field()
            points = self.showcase.current.sampled.points.double() * length_of(field)
            settings = None if self.book is None else self.book.settings
            self._finder = (revision.number, Finder(field, points.float(), length_of(field), settings))
        return self._finder[1]

    def _prepare_ahead(self) -> None:
        if self._ahead is not None:
            self._ahead.cancel()
        if self.session.current.field is not None:
            self._ahead = asyncio.create_task(self._prepare(self.session.current))

    async def _prepare(self, revision: Revision) -> None:
        await asyncio.sleep(_SETTLED)
        finder = self._finder_of(revision)
        await anyio.to_thread.run_sync(partial(self._counted, finder.prepare))

    def _counted(self, act: Callable[..., Result], *arguments: Any) -> Result:
        """Do something in a thread that may outlive the server."""
        with self._threads:
            self._busy += 1
        try:
            return act(*arguments)
        finally:
            with self._threads:
                self._busy -= 1

    def _live(self, revision: Revision) -> dict[str, Any]:
        abilities = []
        field, running = revision.field, self.jobs.current
        rows: list[int] = []
        if field is not None:
            abilities += ["locate", "edit", "save", "like", *(["words"] if self.model is not None else [])]
            rows = field.audible.nonzero().flatten().tolist()
        if self.book is not None:
            abilities += ["capture", "reconstruct"]
        return {
            "revision": revision.number,
            "undo": self.session.can_undo,
            "abilities": abilities,
            "mode": "capture" if field is None else "field",
            "sliders": revision.sliders.to_json(),
            "remarks": [*self.showcase.current.remarks, *revision.remarks],
            "rows": rows,
            "materials": list(MATERIAL_NAMES),
            "job": None if running is None else running.identifier,
        }

    async def _computed(self, act: Callable[..., Result], *arguments: Any) -> Result:
        return await anyio.to_thread.run_sync(partial(self._counted, act, *arguments), limiter=self._computing)

    async def _written(self, act: Callable[..., Result], *arguments: Any) -> Result:
        return await anyio.to_thread.run_sync(partial(act, *arguments), limiter=self._writing)


def words_model(given: str | None) -> str | None:
    """Return the model for edits by words: the given one, that of the hub's cache, or None where none can be used."""
    if any(find_spec(name) is None for name in ("diffusers", "torchsde", "transformers")):
        return None
    if given is not None:
        return given
    from huggingface_hub import try_to_load_from_cache

    return STABLE_AUDIO if isinstance(try_to_load_from_cache(STABLE_AUDIO, "model_index.json"), str) else None


def base_of(words: dict[str, Any]) -> int:
    """Return the revision that a change is of. Raises RefusedError (400) where the page does not say."""
    base = words.get("base")
    if not isinstance(base, int) or isinstance(base, bool):
        raise RefusedError(400, f'"base": expected the revision that the change is of, found {base!r}: reload the page')
    return base


def _unpacked(text: Any) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (TypeError, ValueError, binascii.Error) as error:
        raise RefusedError(400, "like: expected a recording as base64, found what is none: reload the page") from error
