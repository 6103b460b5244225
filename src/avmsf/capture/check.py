"""Everything that is wrong with a capture folder, found without stopping at the first thing."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import number_key
from avmsf.capture.folder import read_strike
from avmsf.capture.measure import RecordingReport
from avmsf.capture.prepare import Prepared, margin_length
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.starts import are_uncut
from avmsf.capture.table import (
    FARTHEST,
    TABLE,
    Row,
    Strike,
    fitting_units,
    is_missing,
    parse_row,
    read_rows,
    refuse_missing,
    refuse_repeated_files,
)
from avmsf.capture.together import check_contacts, check_levels, check_surface, common_length, common_rate, find_surface
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


@dataclass(frozen=True, eq=False)
class _Sound:
    """What the recordings are compared by."""

    file: str
    samples: int
    """From the onset to the end."""
    rate: float
    peak: float
    digest: bytes
    start: Prepared
    """With no more than the first `margin_length` samples of the sound."""


def check(folder: str | Path, settings: CaptureSettings | None = None) -> CaptureReport:
    """Check a capture folder as `read_capture` would and report on every recording; raises nothing for bad input."""
    folder = Path(folder)
    try:
        settings = settings or settings_of(folder)
        rows, warned = read_rows(folder)
    except CaptureError as error:
        return CaptureReport(False, (), (str(error),))
    problems = [str(each) for each in warned]
    reports, strikes, sounds = list[RecordingReport](), list[Strike](), list[_Sound]()
    far = dict[int, float]()
    for row in rows:
        strike, prepared, report = _check_row(folder, row, settings=settings, far=far)
        reports.append(report)
        if strike is not None:
            strikes.append(strike)
        if prepared is not None:
            rate = report.sample_rate or 0.0
            start = replace(prepared, sound=prepared.sound[: margin_length(rate)].copy())
            digest = hashlib.sha256(prepared.sound.tobytes()).digest()
            sounds.append(_Sound(report.file, len(prepared.sound), rate, prepared.peak, digest, start))
    if len(far) > 1:
        # One message for all, with which they are listed together.
        largest = max(far.values())
        words = (
            f"expected a contact within {FARTHEST:g} m of the origin, got coordinates of up to {largest:g} "
            f"(unit = {settings.unit!r}): {fitting_units(largest)}"
        )
        reports = [replace(each, problems=(words,)) if each.line in far else each for each in reports]
    refused: list[str] = []
    problems += map(str, check_contacts(strikes, settings) if strikes else ())
    with _collected(refused):
        refuse_repeated_files(strikes)
    with _collected(refused):
        refuse_missing(folder, strikes)
    with _collected(refused):
        surface = find_surface(folder, settings)
        if surface is not None and strikes:
            problems += map(str, check_surface(strikes, surface, settings=settings))
    comparable = len(sounds) > 1 and len({each.rate for each in sounds}) == 1
    uncut = comparable and are_uncut([each.start for each in sounds], rate=sounds[0].rate, settings=settings)
    if uncut:
        reports = [each if each.onset_seconds is None else replace(each, onset_seconds=0.0) for each in reports]
        sounds = [replace(each, samples=each.samples + each.start.onset) for each in sounds]
    if sounds:
        names = [each.file for each in sounds]
        with _collected(refused):
            rate = common_rate([each.rate for each in sounds], names)
            lengths = [each.samples for each in sounds]
            problems += map(str, common_length(lengths, names, rate=rate, settings=settings)[1])
        with _collected(refused):
            problems += map(str, check_levels([each.peak for each in sounds], names))
    problems += _copies(sounds) + _unlisted(folder, {report.file for report in reports})
    readable = not refused and all(report.readable for report in reports)
    remarks = [UNCUT] if uncut else []
    names = [report.file for report in reports]
    if names == sorted(names) != sorted(names, key=number_key):
        remarks.append(TEXT_ORDER)
    return CaptureReport(readable, tuple(reports), tuple(refused + problems), tuple(remarks))


@contextmanager
def _collected(refused: list[str]) -> Iterator[None]:
    """Add a CaptureError's message to what makes the folder unreadable, and go on."""
    try:
        yield
    except CaptureError as error:
        refused.append(str(error))


def _copies(sounds: Sequence[_Sound]) -> list[str]:
    """Return a sentence for each sound that is another one's copy."""
    first = {each.digest: each.file for each in reversed(sounds)}
    return [
        f"{each.file}: the same sound as {first[each.digest]}, to the last bit: copy the right file, or remove its row"
        for each in sounds
        if each.file != first[each.digest]
    ]


def _unlisted(folder: Path, named: set[str]) -> list[str]:
    """Return a sentence on wav files without a row; hidden ones, such as what the studio has removed, are left out."""
    names = (path.relative_to(folder) for path in folder.rglob("*.wav"))
    found = sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))
    unlisted = [name for name in found if name not in named]
    if not unlisted:
        return []
    lack = f"{counted(len(unlisted), 'wav file')} {'has' if len(unlisted) == 1 else 'have'} no row in {TABLE}"
    return [f"{lack}: {listed(unlisted)}"]


def _check_row(
    folder: Path, row: Row, *, settings: CaptureSettings, far: dict[int, float]
) -> tuple[Strike | None, Prepared | None, RecordingReport]:
    """Return one row parsed as far as possible, its sound, and its report.

    The largest coordinate of a contact too far away is added, by its line, to `far`.
    """
    strike = None
    try:
        strike = parse_row(row, settings)
        if is_missing(folder / strike.file):
            raise CaptureError(f"{strike.file}: expected a sound file, got none", file=strike.file)
        prepared, report = read_strike(folder, strike, settings=settings)
    except CaptureError as error:
        if error.name == "unit":
            far[row.line] = max(map(abs, error.value))
        file = strike.file if strike is not None else row.cells["file"]
        return strike, None, RecordingReport(file=file, line=row.line, readable=False, problems=(str(error),))
    return strike, prepared, report
