"""Localization for the page: tables are computed in advance, so that a recording is located at once."""

import asyncio
import base64
import dataclasses
import sys
import traceback
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import printable
from avmsf.capture.audio import Recording
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import AvmsfError
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locate import locate_impacts
from avmsf.localization.locator import Locator
from avmsf.studio.capture import CaptureEditor
from avmsf.studio.files import Showcase
from avmsf.studio.jobs import Threads
from avmsf.studio.responses import FORESEEN_ERRORS
from avmsf.studio.session import Revision, Session


@dataclass(frozen=True, eq=False)
class Finder:
    """The locator of one revision of a field, made at its first use."""

    field: SoundField
    points: Float[Tensor, "points 3"]
    """The page's points, on the object as the field has it now, meters."""
    length: float
    """Lengths on that object over those of the page's picture."""
    settings: CaptureSettings | None
    """How the capture's recordings are read, where it is known."""
    _lock: Lock = dataclasses.field(default_factory=Lock, repr=False)

    @cached_property
    def locator(self) -> Locator:
        """The tables over the page's points."""
        return Locator.of(self.field, points=self.points)

    def prepare(self) -> None:
        """Compute the tables, once for all threads."""
        with self._lock:
            self.locator.prepare(self.field.samples)

    def locate(self, recording: Recording) -> list[dict[str, Any]]:
        """Return the impacts of a recording, each with a value for every point of the page.

        Lengths are in the page's frame, meters. Raises LocationError as `locate_impacts`.
        """
        self.prepare()
        impacts = locate_impacts(self.field, recording, settings=self.settings, locator=self.locator)
        return [self._described(seconds, contact) for seconds, contact in impacts]

    def _described(self, seconds: float, contact: ContactPosterior) -> dict[str, Any]:
        values = contact.describe()
        del values["cosine"]
        for each in (values, *values["equivalent_points"]):
            each["position"] = [value / self.length for value in each["position"]]
        values["credible_region"]["radius"] /= self.length
        # As the page unpacks it: float32, little endian.
        probability = contact.probability.detach().to(torch.float32).numpy().astype("<f4").tobytes()
        packed = base64.b64encode(probability).decode()
        return {"seconds": seconds, "row": contact.most_probable, "probability": packed, **values}


class Searches:
    """The finders of one server. Its methods are called on the event loop."""

    def __init__(self, session: Session, showcase: Showcase, editor: CaptureEditor | None, threads: Threads) -> None:
        self.session, self.showcase, self.editor, self.threads = session, showcase, editor, threads
        self._finder: tuple[int, Finder] | None = None
        self._ahead: asyncio.Task[None] | None = None

    def finder_of(self, revision: Revision) -> Finder:
        """Return the locator of a revision; its tables are computed at the first use."""
        if self._finder is None or self._finder[0] != revision.number:
            field = revision.require_field()
            length = field.gain_field.length
            points = (self.showcase.current.sampled.points.double() * length).float()
            settings = None if self.editor is None else self.editor.settings
            self._finder = (revision.number, Finder(field, points, length, settings))
        return self._finder[1]

    def prepare_ahead(self) -> None:
        """Compute the current revision's tables after the running computation, and skip those of older revisions."""
        if self._ahead is None or self._ahead.done():
            self._ahead = asyncio.create_task(self._prepare())

    def close(self) -> None:
        """Start no further computation."""
        if self._ahead is not None:
            self._ahead.cancel()

    async def _prepare(self) -> None:
        # One task for all revisions: one that is cancelled would leave its thread running while the next one's runs.
        prepared = None
        while (revision := self.session.current) is not prepared and revision.field is not None:
            # Sliders are dragged: most revisions are soon not the last one.
            await asyncio.sleep(0.5)
            if self.session.current is revision:
                try:
                    await self.threads.run("prepare", self.finder_of(revision).prepare)
                except Exception as error:  # the next revision's tables are to be made all the same
                    _report(error)
                prepared = revision


def _report(error: Exception) -> None:
    """Print why tables could not be made. A page that asks to locate on this revision gets the same error."""
    if not isinstance(error, (AvmsfError, *FORESEEN_ERRORS)):
        traceback.print_exception(error)
    message = printable(" ".join(str(error).split()))
    print(f"impacts cannot be located on this revision ({type(error).__name__}: {message})", file=sys.stderr)
