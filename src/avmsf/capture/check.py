"""Everything that is wrong with a capture folder, found without stopping at the first thing."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import number_key
from avmsf.capture.measure import RecordingReport
from avmsf.capture.preprocess import Issues, Preprocessed, are_uncut, preprocess
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.table import FARTHEST, TABLE, Row, fitting_units
from avmsf.errors import CaptureError

UNCUT = "all recordings start with the impact, as impulse responses do, and are not cut"
TEXT_ORDER = (
    f"the rows of {TABLE} have the files in the order of text (1, 10, 2), not of numbers (1, 2, 10): make sure that "
    "the contacts are in this order, too"
)


@dataclass(frozen=True)
class CaptureReport:
    """What `check` found, in plain values: `dataclasses.asdict` gives what JSON holds."""

    readable: bool
    """Whether `read_capture` would read this folder (perhaps with warnings)."""
    recordings: tuple[RecordingReport, ...]
    """One for each row of impacts.csv, in its order."""
    problems: tuple[str, ...]
    """What is wrong with the folder, its table, its surface, or the recordings together."""
    remarks: tuple[str, ...] = ()
    """Notes on the recordings together that are no problems."""


def check(folder: str | Path, settings: CaptureSettings | None = None) -> CaptureReport:
    """Check a capture folder as `read_capture` would and report on every recording; raises nothing for bad input."""
    folder, issues = Path(folder), Issues(collect=True)
    try:
        settings = settings or settings_of(folder)
        found = preprocess(folder, settings, issues)
    except CaptureError as error:
        return CaptureReport(False, (), (str(error),))
    reports = [found.reports.get(row.line) or _unreadable(row, found, issues) for row in found.rows]
    far = [error for error in issues.rows.values() if error.name == "unit"]
    if len(far) > 1:
        # One message for all, with which they are listed together.
        largest = max(abs(value) for error in far for value in error.value)
        words = (
            f"expected a contact within {FARTHEST:g} m of the origin, got coordinates of up to {largest:g} "
            f"(unit = {settings.unit!r}): {fitting_units(largest)}"
        )
        lines = [line for line, error in issues.rows.items() if error in far]
        reports = [replace(each, problems=(words,)) if each.line in lines else each for each in reports]
    sounds = list(found.sounds.values())
    comparable = len(sounds) > 1 and len({each.rate for each in sounds}) == 1
    remarks = []
    if comparable and are_uncut(sounds, settings):
        reports = [each if each.onset_seconds is None else replace(each, onset_seconds=0.0) for each in reports]
        remarks.append(UNCUT)
    names = [report.file for report in reports]
    if names == sorted(names) != sorted(names, key=number_key):
        remarks.append(TEXT_ORDER)
    readable = not issues.errors and all(report.readable for report in reports)
    problems = [*map(str, issues.errors), *map(str, issues.warnings), *_copies(found), *_unlisted(folder, set(names))]
    return CaptureReport(readable, tuple(reports), tuple(problems), tuple(remarks))


def _unreadable(row: Row, found: Preprocessed, issues: Issues) -> RecordingReport:
    strike = found.strikes.get(row.line)
    file = row.cells["file"] if strike is None else strike.file
    return RecordingReport(file=file, line=row.line, readable=False, problems=(str(issues.rows[row.line]),))


def _copies(found: Preprocessed) -> list[str]:
    """Return a sentence for each sound that is another one's copy."""
    first, sentences = dict[bytes, str](), []
    for line, sound in found.sounds.items():
        file = found.strikes[line].file
        original = first.setdefault(hashlib.sha256(sound.sound.tobytes()).digest(), file)
        if original != file:
            advice = "copy the right file, or remove its row"
            sentences.append(f"{file}: the same sound as {original}, to the last bit: {advice}")
    return sentences


def _unlisted(folder: Path, named: set[str]) -> list[str]:
    """Return a sentence on wav files without a row; hidden ones, such as what the studio has removed, are left out."""
    names = (path.relative_to(folder) for path in folder.rglob("*.wav"))
    found = sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))
    unlisted = [name for name in found if name not in named]
    if not unlisted:
        return []
    lack = f"{counted(len(unlisted), 'wav file')} {'has' if len(unlisted) == 1 else 'have'} no row in {TABLE}"
    return [f"{lack}: {listed(unlisted)}"]
