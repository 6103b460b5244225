"""Localization tables of the current revision, computed as soon as the sliders are at rest."""

import asyncio
import sys
import traceback
from collections import defaultdict

from avmsf._utils.text import printable
from avmsf.errors import AvmsfError
from avmsf.field.scaled_gains import length_of
from avmsf.studio.capturing import StrikeBook
from avmsf.studio.locating import Finder, Likeness
from avmsf.studio.refusal import FORESEEN_ERRORS
from avmsf.studio.session import Revision, Session
from avmsf.studio.showing import Showcase
from avmsf.studio.threads import Threads

_SETTLED = 0.5
"""Seconds that a revision stays the last one before its tables are made: sliders are dragged."""


class Searches:
    """The finders of one server. Its methods are called on the event loop."""

    def __init__(self, session: Session, showcase: Showcase, book: StrikeBook | None, threads: Threads) -> None:
        self.session, self.showcase, self.book, self.threads = session, showcase, book, threads
        self._finder: tuple[int, Finder] | None = None
        self._likenesses: defaultdict[int, Likeness] = defaultdict(Likeness)
        self._ahead: asyncio.Task[None] | None = None

    def finder_of(self, revision: Revision) -> Finder:
        """Return the locator of a revision; its tables are computed at the first use."""
        if self._finder is None or self._finder[0] != revision.number:
            field = revision.expect_field()
            points = self.showcase.current.sampled.points.double() * length_of(field.gain_field)
            settings = None if self.book is None else self.book.settings
            likeness = self._likenesses[revision.opening]
            self._finder = (
                revision.number,
                Finder(field, points.float(), length_of(field.gain_field), likeness, settings),
            )
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
        # One task for all revisions: one that is cancelled would leave its thread running beside the next one's.
        prepared = None
        while (revision := self.session.current) is not prepared and revision.field is not None:
            await asyncio.sleep(_SETTLED)
            if self.session.current is revision:
                try:
                    await self.threads.compute_ahead(self.finder_of(revision).prepare)
                except Exception as error:  # the next revision's tables are to be made all the same
                    _report(error)
                prepared = revision


def _report(error: Exception) -> None:
    """Print why tables could not be made. A page that asks to locate on this revision gets the same error."""
    if not isinstance(error, (AvmsfError, *FORESEEN_ERRORS)):
        traceback.print_exception(error)
    words = printable(" ".join(str(error).split()))
    print(f"impacts cannot be located on this revision ({type(error).__name__}: {words})", file=sys.stderr)
