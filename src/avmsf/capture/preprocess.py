"""From a capture folder to impacts of one rate and length, with all that is found wrong on the way."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from avmsf.capture.audio import read_recording
from avmsf.capture.impacts import Impacts
from avmsf.capture.measure import RecordingReport, measure
from avmsf.capture.prepare import Prepared, prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.starts import build_impacts, shorten
from avmsf.capture.table import (
    TABLE,
    Row,
    Strike,
    is_missing,
    parse_row,
    read_rows,
    refuse_missing,
    refuse_repeated_files,
)
from avmsf.capture.together import check_contacts, check_levels, check_surface, find_surface
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface, contacted_part


@dataclass
class Issues:
    """What is wrong with a capture. Errors are raised, unless `collect` is set: then they are kept."""

    collect: bool = False
    errors: list[CaptureError] = field(default_factory=list)
    rows: dict[int, CaptureError] = field(default_factory=dict)
    """Errors of single recordings, by their lines in the table."""
    warnings: list[CaptureWarning] = field(default_factory=list)

    @contextmanager
    def kept(self, line: int | None = None) -> Iterator[None]:
        """Keep an error, of the capture or of one row of its table, and go on."""
        try:
            yield
        except CaptureError as error:
            if not self.collect:
                raise
            if line is None:
                self.errors.append(error)
            else:
                self.rows[line] = error


@dataclass
class Preprocessed:
    """What could be read of a capture folder."""

    rows: list[Row]
    strikes: dict[int, Strike] = field(default_factory=dict)
    """The rows that can be parsed, by their lines."""
    reports: dict[int, RecordingReport] = field(default_factory=dict)
    """On the recordings that can be read, by their lines."""
    sounds: dict[int, Prepared] = field(default_factory=dict)
    """These recordings, as far as they are used."""
    surface: Surface | None = None
    """The part of it that the contacts lie on."""
    impacts: Impacts | None = None


def preprocess(folder: Path, settings: CaptureSettings, issues: Issues) -> Preprocessed:
    """Read a capture folder; what is wrong with it is raised or kept, as `issues` say.

    Raises `CaptureError` for a table that cannot be read in any case.
    """
    rows, warned = read_rows(folder)
    issues.warnings += warned
    found = Preprocessed(rows)
    for row in rows:
        with issues.kept(row.line):
            found.strikes[row.line] = parse_row(row, settings)
    strikes = list(found.strikes.values())
    if strikes:
        with issues.kept():
            refuse_repeated_files(strikes)
        with issues.kept():
            refuse_missing(folder, strikes)
        issues.warnings += check_contacts(strikes, settings)
    with issues.kept():
        found.surface = find_surface(folder, settings)
        if found.surface is not None and strikes:
            issues.warnings += check_surface(strikes, found.surface, settings=settings)
            contacts = torch.tensor([strike.contact for strike in strikes])
            found.surface, _ = contacted_part(found.surface, contacts)
    for line, strike in found.strikes.items():
        with issues.kept(line):
            # Reading would name similar files, for which it compares up to a thousand names.
            if is_missing(folder / strike.file):
                raise CaptureError.expected("a sound file", file=strike.file)
            advice = f"copy it there, or remove its row from {TABLE}"
            recording = read_recording(folder / strike.file, strike.file, advice=advice)
            prepared = prepare(recording, settings, newtons=strike.newtons)
            found.reports[line] = measure(recording, prepared, settings=settings, line=line)
            found.sounds[line] = shorten(prepared, settings)
    _join(found, settings, issues)
    return found


def _join(found: Preprocessed, settings: CaptureSettings, issues: Issues) -> None:
    """Make impacts of the recordings that can be read, and compare them."""
    strikes, sounds = [found.strikes[line] for line in found.sounds], list(found.sounds.values())
    if not sounds:
        return
    names, directions = [strike.file for strike in strikes], [strike.direction for strike in strikes]
    with issues.kept():
        issues.warnings += check_levels([sound.peak for sound in sounds], names)
    with issues.kept():
        found.impacts, warned = build_impacts(
            sounds,
            torch.tensor([strike.contact for strike in strikes], dtype=torch.float64),
            names=names,
            settings=settings,
            directions=None if None in directions else torch.tensor(directions, dtype=torch.float32),
        )
        issues.warnings += warned
