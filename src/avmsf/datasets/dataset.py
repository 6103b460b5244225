"""The interface of collections of recorded objects."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from avmsf.capture.folder import Capture
from avmsf.capture.settings import CaptureSettings


@dataclass(frozen=True)
class ObjectFacts:
    """Name and material of one object."""

    identifier: str
    """Its identifier in the dataset: a number, or a folder's name."""
    name: str
    """A name in plain English, or the identifier."""
    material: str | None = None
    """In lower case, such as `ceramic`; None where it is unknown."""
    inferred: bool = False
    """Whether name and material are inferred from tables that do not fit exactly, rather than read."""


@dataclass(frozen=True)
class VisualSource:
    """Visual source of an object."""

    folder: Path
    """Folder with photographs, Gaussians or a mesh, like a capture folder."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """Name of the mesh, where it differs from a capture folder's, and units."""


@dataclass(frozen=True)
class ObjectReport:
    """Available data of one object."""

    facts: ObjectFacts
    recordings: int
    """Number of usable recordings with contacts."""
    problems: tuple[str, ...] = ()
    """Messages on missing or unusable data; empty if complete."""


@dataclass(frozen=True)
class DatasetReport:
    """Available data of a dataset."""

    dataset: str
    """Its name."""
    objects: tuple[ObjectReport, ...]
    missing: tuple[str, ...] = ()
    """Missing parts, with what to download and where to put it."""
    remarks: tuple[str, ...] = ()
    """Further notes, such as objects shared with another dataset."""


@runtime_checkable
class Dataset(Protocol):
    """Many objects, each of which can be read as a capture."""

    @property
    def name(self) -> str:
        """Name of the dataset in reports."""

    def objects(self) -> tuple[str, ...]:
        """Return the identifiers of all objects that have recordings here, in natural order."""

    def facts(self, identifier: str) -> ObjectFacts:
        """Return an object's name and material. Raises DatasetError for an unknown one."""

    def capture(self, identifier: str) -> Capture:
        """Read one object's recordings. Raises DatasetError for an unknown or an incomplete one."""

    def visual_source(self, identifier: str) -> VisualSource | None:
        """Return the object's visual source; None where there is neither mesh nor photograph."""

    def check(self) -> DatasetReport:
        """Report available and missing data, without reading the sounds."""
