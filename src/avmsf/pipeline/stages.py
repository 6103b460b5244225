"""Stages: functions whose outputs a folder keeps, each next to the record of what it was made from.

A `Stage` is a name, the stages that it depends on, and a function. A `Pipeline` is a list of them, each of which is
made, after those that it depends on, when it is first asked for, unless a `StageFolder` keeps it already.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import avmsf
from avmsf._utils.caching import discard, source_digest
from avmsf._utils.files import write_whole
from avmsf._utils.processes import WAIT, write_lock
from avmsf._utils.progress import ProgressListener
from avmsf._utils.text import read_json_object
from avmsf.errors import CaptureError


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
    values: Mapping[str, Any]
    """What its function returned of plain values when it ran."""


@dataclass(frozen=True)
class Stage:
    """One step from a capture to a field."""

    name: str
    """Of its output in the folder."""
    make: Callable[..., Mapping[str, Any] | None]
    """Receives the output's path, and those of the stages that it depends on; leaves it whole or not at all. What plain
    values it returns are kept too."""
    inputs: tuple[str, ...] = ()
    """The stages that it depends on."""
    recipe: Callable[[], Mapping[str, Any]] = dict
    """Returns the plain values that decide the output besides these, digests of files among them."""
    usable: Callable[[Path], bool] | None = None
    """Whether an output of the same recipe may be used; by default it may."""


class StageFolder:
    """A folder of stages' outputs, `NAME` beside `NAME.stage.json`, its recipe.

    A stage runs again where its recipe has changed, where its output was changed or is missing, and where other source
    files of this package made it. The record gets the output's digest last, so that an interrupted stage runs again;
    what it left in its checkpoint is there then, unless its recipe has changed meanwhile.
    """

    def __init__(self, folder: Path, option: str = "--cache") -> None:
        self.folder, self.option = folder, option

    def lock(self, command: str, *, wait: float = WAIT) -> AbstractContextManager[None]:
        """Return a context in which no other process or thread makes or replaces a stage here.

        Hold it from the first stage until the last output is read: stages read each other's files. Raises
        FolderInUseError where another process, which is told `command`, holds it for longer than `wait` seconds.
        """
        advice = f", or choose another folder by {self.option}"
        return write_lock(self.folder, "stages", command=command, wait=wait, advice=advice, parents=True)

    def path(self, name: str) -> Path:
        """Return where a stage's output is."""
        return self.folder / name

    def checkpoint(self, name: str) -> Path:
        """Return where a stage may leave its state until it is done."""
        return self.folder / f"{name}.checkpoint"

    def keep(self, stage: Stage, inputs: Mapping[str, Kept] | None = None) -> Kept:
        """Return a stage's output, made of `inputs` where what is kept is not of its recipe and of these.

        Raises as the stage, and `CaptureError` where the folder cannot be written.
        """
        name, inputs = stage.name, inputs or {}
        path, record = self.path(name), self.folder / f"{name}.stage.json"
        key = {"version": avmsf.__version__, "source": source_digest(stage.make.__module__), **stage.recipe()}
        key |= {"inputs": {each: kept.digest for each, kept in inputs.items()}}
        wanted = json.loads(json.dumps(key, sort_keys=True))
        known: dict[str, Any] = {}
        with suppress(CaptureError):
            known = read_json_object(record, raising=CaptureError)
        same = known.get("recipe") == wanted
        current = same and path.exists() and digest_of(path) == known.get("digest")
        if not same:
            self.checkpoint(name).unlink(missing_ok=True)
        if current and (stage.usable is None or stage.usable(path)):
            seconds = float(known.get("seconds", 0.0))
            return Kept(path, known["digest"], seconds, fresh=False, values=known.get("values", {}))
        self._write(record, {"recipe": wanted, "digest": None, "seconds": 0.0})
        begun = time.monotonic()
        values = stage.make(path, *(kept.path for kept in inputs.values())) or {}
        digest, seconds = digest_of(path), time.monotonic() - begun
        self._write(record, {"recipe": wanted, "digest": digest, "seconds": round(seconds, 3), "values": values})
        discard(self.checkpoint(name))
        return Kept(path, digest, seconds, fresh=True, values=values)

    def _write(self, record: Path, values: Mapping[str, Any]) -> None:
        try:
            write_whole(record, json.dumps(values, indent=1), raising=CaptureError)
        except CaptureError as error:
            raise CaptureError(f"{error}, by {self.option}", **error.attributes) from error


class Pipeline:
    """Stages in a folder, by name: `pipeline[name]` is the output, made when it is first asked for."""

    def __init__(self, folder: StageFolder, stages: Iterable[Stage] = (), *, listener: ProgressListener) -> None:
        self.folder, self.listener = folder, listener
        self.stages = {stage.name: stage for stage in stages}
        self.made: dict[str, Kept] = {}
        """The outputs that were asked for so far, in order."""

    def __getitem__(self, name: str) -> Kept:
        if name not in self.made:
            stage = self.stages[name]
            kept = self.folder.keep(stage, {each: self[each] for each in stage.inputs})
            self.made[name] = kept
            self.listener.ready(Path(name).stem, kept.seconds if kept.fresh else None)
        return self.made[name]

    def add(self, stage: Stage) -> Kept:
        """Add a stage and return its output."""
        self.stages[stage.name] = stage
        return self[stage.name]


def digest_of(path: Path) -> str:
    """Return a digest of a file's content, or of the names and contents of all files in a folder but hidden ones.

    Symbolic links are followed, to each folder once.
    """
    if not path.is_dir():
        return digest_files([path], root=path.parent)
    found, seen = list[Path](), {path.resolve()}
    for inside, folders, names in os.walk(path, followlinks=True):
        new = {each: place for each in sorted(folders) if (place := Path(inside, each).resolve()) not in seen}
        folders[:] = [each for each in new if not each.startswith(".")]
        seen.update(new.values())
        found += [file for each in names if not each.startswith(".") and (file := Path(inside, each)).is_file()]
    return digest_files(found, root=path)


def digest_files(paths: Iterable[Path], *, root: Path) -> str:
    """Return a digest of files' contents and of their names relative to the folder `root`, in sorted order."""
    digest = hashlib.sha256()
    for path in sorted({*paths}):
        # A camera file may name what lies outside of its folder.
        name = Path(os.path.relpath(path, root)).as_posix()
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
        with open(path, "rb") as file:
            # The digest of all goes on with each file, as the function returns it in place of a new one.
            hashlib.file_digest(file, lambda: digest)
    return digest.hexdigest()
