"""The field that is open in the page: immutable revisions, the last of which is played.

Every change names the revision that it is based on; if another tab was faster, nothing is changed and the page gets a
message. Revision numbers only increase; the number of an undone revision is not used again.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import RLock

from avmsf._utils.files import unwritable
from avmsf.errors import StudioError
from avmsf.field.sound_field import SoundField
from avmsf.field.store import save
from avmsf.studio.edit import REST, Sliders
from avmsf.studio.responses import RequestError, bad_request

SUFFIX = ".safetensors"
_NAME = re.compile(r"\w[\w .()+-]{0,99}(?<![. ])")


@dataclass(frozen=True, eq=False)
class Revision:
    """The field at one time."""

    number: int
    opening: int = 0
    """Which field it is of: counts those that were opened."""
    ground: SoundField | None = None
    """The field as opened, saved or optimized last, to which the sliders are relative; None without a field."""
    sliders: Sliders = REST
    """What was done to it since."""
    field: SoundField | None = None
    """The field that is played."""
    remarks: tuple[str, ...] = ()
    """What its owner should know of it."""
    name: str | None = None
    """What it, or what it was made of, was saved as last; None for as it was opened."""

    def require_field(self) -> SoundField:
        """Return the field that is played. Raises RequestError (409) without a field."""
        if self.field is None:
            advice = "record impacts and reconstruct it first"
            raise bad_request("field", "one", got="none yet", advice=advice, status=409)
        return self.field


class Session:
    """The revisions. Its methods may be called from any thread; `publish` is called for a revision before it counts."""

    def __init__(self, home: Path, publish: Callable[[Revision], None]) -> None:
        self.home, self._publish = home, publish
        self.current = Revision(0)
        """The current revision."""
        self._past: list[Revision] = []
        self._lock = RLock()

    @property
    def can_undo(self) -> bool:
        """Whether there is a revision to go back to."""
        return bool(self._past)

    def open(self, field: SoundField | None) -> Revision:
        """Make a field, or none, the current one; the previous one can be restored by undo."""
        with self._lock:
            before = self.current
            fresh = Revision(0, before.opening + 1, ground=field, field=field)
            return self._advance(fresh) if before.field is None else self._remember(fresh)

    def edit(self, base: int, sliders: Sliders) -> Revision:
        """Set the sliders. Raises RequestError (409) if `base` is not the current revision, and the errors of edits."""
        with self._lock:
            self.check_current(base)
            field, remarks = sliders.apply(self.current.ground or self.current.require_field())
            return self._remember(replace(self.current, sliders=sliders, field=field, remarks=tuple(remarks)))

    def lead(self, field: SoundField, remarks: tuple[str, ...]) -> Revision:
        """Take in what a guided edit has made; sliders are relative to it from then on."""
        with self._lock:
            return self._remember(replace(self.current, ground=field, sliders=REST, field=field, remarks=remarks))

    def undo(self, base: int) -> Revision:
        """Undo the last revision, under a new number. Raises RequestError (409) as `edit`, and if there is no other."""
        with self._lock:
            self.check_current(base)
            if not self._past:
                raise bad_request("undo", "a change", got="none since the field was opened", status=409)
            undone = self._advance(self._past[-1])
            self._past.pop()
            return undone

    def save(self, base: int, name: str) -> tuple[Path, Revision]:
        """Write the current field to a new file of the folder, and make the sliders relative to it.

        Raises RequestError if a file of this name exists (409), or the name is invalid (400).
        """
        with self._lock:
            self.check_current(base)
            field = self.current.require_field()
            path = self.home / file_name(name)
            _write_new(field, path)
            saved = replace(self.current, ground=field, sliders=REST, name=path.name.removesuffix(SUFFIX))
            try:
                return path, self._advance(saved)
            except BaseException:
                # What is answered by an error was not done, so that it can be asked for again.
                path.unlink(missing_ok=True)
                raise

    def check_current(self, base: int) -> None:
        """Raise RequestError (409), with the current revision, if `base` is another one."""
        if base != self.current.number:
            now, got = self.current.number, "an older one: another tab has changed it"
            advice = "nothing was overwritten; make the change again"
            raise bad_request("base", "the current field", base, got=got, advice=advice, status=409, revision=now)

    def _remember(self, revision: Revision) -> Revision:
        before = self.current
        changed = self._advance(revision)
        # At most 100 steps back.
        self._past = [*self._past, before][-100:]
        return changed

    def _advance(self, revision: Revision) -> Revision:
        numbered = replace(revision, number=self.current.number + 1)
        self._publish(numbered)
        self.current = numbered
        return numbered


def _write_new(field: SoundField, path: Path) -> None:
    """Write a field to a new file. Raises RequestError (409) if the file exists, and StudioError."""
    try:
        path.touch(exist_ok=False)
    except FileExistsError as error:
        message = f"{path.name}: expected a new name, got an existing file; choose another name"
        raise RequestError(409, message, file=path) from error
    except OSError as error:
        raise unwritable(path, error, raising=StudioError) from error
    try:
        save(field, path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def file_name(name: str) -> str:
    """Return the file of a name that the user gave. Raises RequestError (400) for a name with a path."""
    stem = name.strip().removesuffix(SUFFIX)
    if not _NAME.fullmatch(stem):
        raise bad_request("name", "letters, digits, spaces, - and _, such as bowl in wood", name)
    return f"{stem}{SUFFIX}"
