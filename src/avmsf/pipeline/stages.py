"""What each stage of a fit made, kept in a folder next to the record of what it was made from."""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import avmsf
from avmsf._utils.caching import discard, source_digest
from avmsf._utils.files import way_out, write_whole
from avmsf._utils.processes import WAIT, write_lock
from avmsf._utils.text import read_json
from avmsf.errors import CaptureError

_BLOCK = 1 << 20


@dataclass(frozen=True)
class Kept:
    """One stage's output."""

    path: Path
    """The file, or the folder of files, that the stage made."""
    digest: str
    """Of its content: what a later stage's recipe names it by."""
    seconds: float
    """How long the stage took when it ran."""
    fresh: bool
    """Whether it ran now."""


class StageFolder:
    """A folder of stages' outputs, `NAME` beside `NAME.stage.json`, its recipe.

    A stage runs again where its recipe has changed, where its output was changed or is missing, and where other source
    files of this package made it. The record gets the output's digest last, so that an interrupted stage runs again;
    what it left in its checkpoint is there then, unless its recipe has changed meanwhile.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._counted: Sequence[str] = ()
        self._log: Callable[[str], None] = lambda message: None

    def count(self, names: Sequence[str], log: Callable[[str], None]) -> None:
        """From now on log the number of each of these outputs when its turn comes, such as "2 of 5: modes (cached)".

        They come in this order; some may be left out.
        """
        self._counted, self._log = names, log

    def lock(self, command: str, *, wait: float = WAIT) -> AbstractContextManager[None]:
        """Return a context in which no other process or thread makes or replaces a stage here.

        Hold it from the first stage until the last output is read: stages read each other's files. Raises
        FolderInUseError where another process, which is told `command`, holds it for longer than `wait` seconds.
        """
        advice = ", or choose another folder by --cache"
        return write_lock(self.folder, "stages", command=command, wait=wait, advice=advice, parents=True)

    def path(self, name: str) -> Path:
        """Return where a stage's output is."""
        return self.folder / name

    def checkpoint(self, name: str) -> Path:
        """Return where a stage may leave its state until it is done."""
        return self.folder / f"{name}.checkpoint"

    def keep(
        self,
        name: str,
        recipe: Mapping[str, Any],
        make: Callable[[Path], object],
        *,
        usable: Callable[[Path], bool] | None = None,
    ) -> Kept:
        """Return the output called `name`, made by `make(path)` where what is kept is not of this recipe.

        `recipe` holds plain values that decide the output, digests of inputs among them. `make` leaves the output whole
        or not at all. An output of this recipe that `usable(path)` finds wanting is made again too. Raises as `make`,
        and `CaptureError` where the folder cannot be written.
        """
        path, record = self.path(name), self.folder / f"{name}.stage.json"
        key = {"version": avmsf.__version__, "source": source_digest(make.__module__), **recipe}
        wanted = json.loads(json.dumps(key, sort_keys=True))
        known = _read(record)
        same = known.get("recipe") == wanted
        with self._explaining(name):
            current = same and path.exists() and digest_of(path) == known.get("digest")
            if not same:
                self.checkpoint(name).unlink(missing_ok=True)
        fresh = not current or (usable is not None and not usable(path))
        if name in self._counted:
            cached = "" if fresh else " (cached)"
            self._log(f"{self._counted.index(name) + 1} of {len(self._counted)}: {Path(name).stem}{cached}")
        if not fresh:
            return Kept(path, known["digest"], float(known["seconds"]), fresh=False)
        with self._explaining(name):
            _write(record, {"recipe": wanted, "digest": None, "seconds": 0.0})
        begun = time.monotonic()
        make(path)
        with self._explaining(name):
            digest, seconds = digest_of(path), time.monotonic() - begun
            _write(record, {"recipe": wanted, "digest": digest, "seconds": round(seconds, 3)})
        discard(self.checkpoint(name))
        return Kept(path, digest, seconds, fresh=True)

    @contextmanager
    def _explaining(self, name: str) -> Iterator[None]:
        """Turn an OSError into a CaptureError with advice."""
        try:
            yield
        except (OSError, CaptureError) as error:
            cause = error.__cause__ if isinstance(error, CaptureError) else error
            if not isinstance(cause, OSError):
                raise
            reason = cause.strerror or str(cause)
            path = self.path(name)
            raise CaptureError.expected(
                "a readable and writable path", reason, file=path, advice=f"{way_out(cause)} by --cache"
            ) from cause


def digest_of(path: Path) -> str:
    """Return a digest of a file's content, or of the names and contents of all files in a folder."""
    if path.is_dir():
        return digest_files((each for each in path.rglob("*") if each.is_file()), root=path)
    return digest_files([path], root=path.parent)


def digest_files(paths: Iterable[Path], *, root: Path) -> str:
    """Return a digest of files' contents and of their names relative to the folder `root`, in sorted order."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(f"{path.relative_to(root).as_posix()}\0{path.stat().st_size}\0".encode())
        with open(path, "rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _write(record: Path, values: Mapping[str, Any]) -> None:
    words = json.dumps(values, indent=1)
    write_whole(record, words, raising=CaptureError)


def _read(record: Path) -> dict[str, Any]:
    """Return a record, or an empty one where there is none that can be read: its stage then runs again."""
    try:
        known = read_json(record)
    except (OSError, ValueError):
        return {}
    complete = isinstance(known, dict) and {"recipe", "digest", "seconds"} <= known.keys()
    return known if complete else {}
