"""Capture folders side by side in one folder, read as one dataset; and any dataset opened by what its folder holds."""

from functools import cached_property
from pathlib import Path

import soundfile

from avmsf._utils.text import in_order
from avmsf.capture.filenames import find_surface_file, shows_object
from avmsf.capture.folder import Capture, read_capture
from avmsf.capture.issues import Issues
from avmsf.capture.preprocess import common_rate
from avmsf.capture.settings import TABLE, settings_of
from avmsf.capture.table import present_impacts, read_impacts
from avmsf.datasets.dataset import Dataset, DatasetReport, ObjectFacts, ObjectReport, VisualSource
from avmsf.datasets.detect import detect_dataset
from avmsf.datasets.numbering import expect_known
from avmsf.datasets.objectfolder import ObjectFolderRaw
from avmsf.datasets.realimpact import RealImpact
from avmsf.errors import CaptureError, DatasetError


def open_dataset(path: str | Path, *, contacts: str | Path | None = None, time_zero: str | None = None) -> Dataset:
    """Return the dataset that a folder holds, recognized by its files.

    `contacts` is the path of ObjectFolder Real's contacts (`ObjectFolderRaw`). `time_zero` is where sounds start,
    `onset` or `peak`; None leaves that to the dataset or the captures. Raises DatasetError for a folder that holds none
    and for options that the dataset does not take.
    """
    folder = Path(path)
    kind = detect_dataset(folder)
    if kind == "ObjectFolder Real":
        return ObjectFolderRaw(folder, contacts=contacts, time_zero=time_zero)
    if contacts is not None:
        raise DatasetError.expected(
            f"no `contacts` with {kind}", str(contacts), got=str(contacts), file=folder, name="contacts"
        )
    return (CaptureCollection if kind == "captures" else RealImpact)(folder, time_zero=time_zero)


class CaptureCollection:
    """A folder of capture folders, or one capture folder.

    Hidden folders are ignored, and so are folders without a table of impacts, which `check` names. An object has the
    name of its folder. Sounds start where its settings say, unless `time_zero` does.
    """

    name = "captures"

    def __init__(self, folder: str | Path, *, time_zero: str | None = None) -> None:
        self.folder = Path(folder)
        self._time_zero = time_zero

    def objects(self) -> tuple[str, ...]:
        """Return the names of all capture folders, by numbers where they begin with one, else by the alphabet."""
        return tuple(self._folders)

    def facts(self, identifier: str) -> ObjectFacts:
        """Return what the capture is called. Raises DatasetError for an unknown one."""
        folder = self.folder_of(identifier)
        try:
            return ObjectFacts(identifier, settings_of(folder).name or identifier)
        except CaptureError:
            # Settings that cannot be read are reported where they are needed.
            return ObjectFacts(identifier, identifier)

    def capture(self, identifier: str) -> Capture:
        """Read one capture by `read_capture`. Raises DatasetError for an unknown or unreadable one."""
        folder = self.folder_of(identifier)
        try:
            return read_capture(folder, settings_of(folder).starting(self._time_zero))
        except CaptureError as error:
            raise DatasetError(str(error), **error.attributes) from error

    def visual_source(self, identifier: str) -> VisualSource | None:
        """Return the capture's folder where there is anything in it to see. Raises DatasetError for an unknown one and
        for settings that cannot be read."""
        folder = self.folder_of(identifier)
        try:
            settings = settings_of(folder)
            return VisualSource(folder, settings) if shows_object(folder, settings) else None
        except CaptureError as error:
            raise DatasetError(f"{folder}: {error}", **error.attributes) from error

    def check(self) -> DatasetReport:
        """Report what is present and what is missing, from tables and headers; `avmsf check` also reads sounds."""
        reports = tuple(self._report(identifier) for identifier in self.objects())
        known = set(self._folders.values())
        others = in_order(path.name for path in _visible(self.folder) if path not in known and self.folder not in known)
        remarks = (f"folders without {TABLE} are ignored: {', '.join(others)}",) if others else ()
        return DatasetReport(self.name, reports, (), remarks)

    @cached_property
    def _folders(self) -> dict[str, Path]:
        if (self.folder / TABLE).is_file():
            return {self.folder.resolve().name: self.folder}
        found = {path.name: path for path in _visible(self.folder) if (path / TABLE).is_file()}
        return {name: found[name] for name in in_order(found)}

    def folder_of(self, identifier: str) -> Path:
        """Return the folder of a capture. Raises DatasetError for an unknown one."""
        expect_known(identifier, self._folders, str(self.folder))
        return self._folders[identifier]

    def _report(self, identifier: str) -> ObjectReport:
        folder = self._folders[identifier]
        facts = self.facts(identifier)
        try:
            settings = settings_of(folder)
            impacts = read_impacts(folder, settings, Issues())
            files = [each.file for each in present_impacts(folder, impacts, Issues())]
            common_rate([float(soundfile.info(str(folder / file)).samplerate) for file in files], files)
            surface = find_surface_file(folder, settings)
            if surface is not None and not surface.is_file():
                raise CaptureError(f"{surface.name}: the surface of capture.toml is missing", file=surface)
        except (CaptureError, soundfile.LibsndfileError, OSError, TypeError) as error:
            # One row that cannot be read makes `read_capture` refuse the folder.
            return ObjectReport(facts, 0, (str(error),))
        return ObjectReport(facts, len(files))


def _visible(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
