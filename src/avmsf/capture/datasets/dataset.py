"""What every collection of recorded objects answers, whatever its files look like."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings


@dataclass(frozen=True)
class ObjectFacts:
    """What is known of one object besides its recordings."""

    identifier: str
    """What the dataset calls it: a number, or a folder's name."""
    name: str
    """In words, or the identifier again."""
    material: str | None = None
    """In lower case, such as `ceramic`; None where it is not told."""
    inferred: bool = False
    """Whether name and material were concluded from tables that do not quite fit, rather than read."""


@dataclass(frozen=True)
class Look:
    """Where an object can be seen."""

    folder: Path
    """Holds photographs, Gaussians or a mesh, as a capture folder does."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """Names the mesh, where it is not called as in a capture folder, and the units."""


@dataclass(frozen=True)
class ObjectReport:
    """What of one object is there."""

    facts: ObjectFacts
    recordings: int
    """Recordings that can be used, contacts included."""
    problems: tuple[str, ...] = ()
    """What is missing or cannot be used, a sentence each; empty where all is there."""


@dataclass(frozen=True)
class DatasetReport:
    """What of a dataset is there."""

    dataset: str
    """Its name."""
    objects: tuple[ObjectReport, ...]
    missing: tuple[str, ...] = ()
    """Whole parts that are not there, with what to download and where to put it."""
    remarks: tuple[str, ...] = ()
    """What a user should know besides, such as objects shared with another dataset."""


@runtime_checkable
class Dataset(Protocol):
    """Many objects, each of which can be read as a capture."""

    @property
    def name(self) -> str:
        """What reports call the dataset."""
        ...

    def objects(self) -> tuple[str, ...]:
        """Return the identifiers of all objects that have recordings here, in natural order."""
        ...

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what is known of an object. Raises DatasetError for an unknown one."""
        ...

    def capture(self, identifier: str) -> Capture:
        """Read one object's recordings. Raises DatasetError for an unknown or an incomplete one."""
        ...

    def look(self, identifier: str) -> Look | None:
        """Return where the object can be seen; None where there is neither mesh nor picture of it."""
        ...

    def check(self) -> DatasetReport:
        """Say what is there and what is missing, without reading the sounds."""
        ...
