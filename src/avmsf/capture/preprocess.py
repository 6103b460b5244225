"""From recordings to impacts of one rate and length, and from a capture folder, with a report of what is wrong in it.

Where the sounds start in their files is decided for all recordings of a capture together.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.text import counted, listed
from avmsf.capture.audio import read_recording
from avmsf.capture.filenames import number_key
from avmsf.capture.impacts import Impacts
from avmsf.capture.measure import RecordingReport, measure
from avmsf.capture.prepare import MIN_MARGIN, Prepared, margin_length, prepare
from avmsf.capture.settings import CaptureSettings, settings_of
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
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface, contacted_part

UNCUT = "all recordings start with the impact, as impulse responses do, and are not cut"
TEXT_ORDER = (
    f"the rows of {TABLE} have the files in the order of text (1, 10, 2), not of numbers (1, 2, 10): make sure that "
    "the contacts are in this order, too"
)
START_LEVEL = 10**-2.0
"""Share of the largest mean square in the first 20 ms that a response must have at its start: -20 dB, the
level (a tenth of the peak) from which `find_onset` counts a swing as the impact's. Impulse responses reach 0 to -3 dB
(aircraft, ruler, tree), recordings with 4 samples to 1 s before the impact -25 to -47 dB."""
MAX_START_SECONDS = 0.001
"""By when `find_onset` must see every recording that starts with the impact. Where modes cancel at first it takes up to
.3 ms (a plate of 43 modes at 96 kHz) and 5 samples (the aircraft at 400 Hz); delays of 1 ms are found on alignment."""


def latest_start(rate: float) -> int:
    """Return the sample before which an onset is found in a recording that starts with its impact, at a rate in Hz."""
    return max(MIN_MARGIN, round(MAX_START_SECONDS * rate))


def start_with_impact(recordings: Sequence[Prepared]) -> bool:
    """Return whether all recordings start with the impact, without anything before it, as impulse responses do.

    A single recording does not show this: the first samples of an impulse response are small where its modes happen to
    cancel, and the first is zero where it is a displacement. Over all recordings modes cancel nowhere, so the mean
    square of sounds of equal energy is within a sixteenth of a period (and the first two samples) nearly as large as
    later: a sine reaches -8 dB by then. With anything before the impact it is that of noise. The period is that of the
    root mean square frequency. Every single onset has to come within `MAX_START_SECONDS` or `MIN_MARGIN` samples as
    well.
    """
    rate = recordings[0].rate
    latest = latest_start(rate)
    if any(each.onset >= latest or len(each.before) < each.onset for each in recordings):
        return False
    size = min(margin_length(rate), *(len(each.before) + len(each.sound) for each in recordings))
    starts = np.stack([np.concatenate([each.before, each.sound[:size]])[:size] for each in recordings])
    starts = starts.astype(np.float64)
    power = starts**2
    energies = np.maximum(power.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    mean = (power / energies).mean(axis=0)
    # The squared difference of a sine's samples is its square times (angle between them)^2, on average.
    angle = np.sqrt((np.diff(starts, axis=1) ** 2 / energies).mean() / mean.mean())
    first = max(2, 1 + round(2 * np.pi / 16 / max(float(angle), 1.0 / size)))
    return bool(mean[:first].max() >= START_LEVEL * mean.max())


def are_uncut(recordings: Sequence[Prepared], settings: CaptureSettings) -> bool:
    """Return whether the recordings of a capture are taken from their files' first sample on, though `align` is set.

    A force channel, `align = false` and `time_zero = "peak"` say where the sounds start.
    """
    return (
        settings.align and not settings.from_peaks and settings.force_channel is None and start_with_impact(recordings)
    )


def shorten(prepared: Prepared, settings: CaptureSettings) -> Prepared:
    """Return a recording in float32 with no more of it than `build_impacts` can use, so that many fit in memory."""
    most = round(settings.kept_seconds(prepared.rate) * prepared.rate) + margin_length(prepared.rate)
    sound, before = (part.astype(np.float32) for part in (prepared.sound[:most], prepared.before))
    return replace(prepared, sound=sound, before=before)


def build_impacts(
    recordings: Sequence[Prepared],
    contacts: Float64[Tensor, "contacts 3"],
    *,
    names: Sequence[str],
    settings: CaptureSettings,
    directions: Float[Tensor, "contacts 3"] | None = None,
) -> tuple[Impacts, list[CaptureWarning]]:
    """Return the impacts, their sounds from their starts on cut to one length, and warnings of what shortens them.

    Recordings that all start with the impact (`are_uncut`) are used whole. Without `align`, or from the peaks on,
    nothing will be moved later, so that `before` and `after` are None. Raises `CaptureError` where sample rates differ,
    and as `common_length`.
    """
    rate = common_rate([each.rate for each in recordings], names)
    if are_uncut(recordings, settings):
        recordings = [
            replace(each, sound=np.concatenate([each.before, each.sound]), before=each.before[:0])
            for each in recordings
        ]
    length, remarks = common_length([len(each.sound) for each in recordings], names, rate=rate, settings=settings)
    before = after = None
    if settings.align and not settings.from_peaks:
        size = margin_length(rate)
        before = torch.full((len(recordings), size), torch.nan)
        after = before.clone()
        for row, each in enumerate(recordings):
            rest = each.sound[length : length + size].astype(np.float32)
            before[row, size - len(each.before) :] = torch.from_numpy(each.before.astype(np.float32))
            after[row, : len(rest)] = torch.from_numpy(rest)
    forces = [each.newtons for each in recordings]
    impacts = Impacts(
        contacts=contacts,
        sounds=torch.from_numpy(np.stack([each.sound[:length] for each in recordings]).astype(np.float32)),
        sample_rate=rate * settings.playback_speed,
        names=tuple(names),
        directions=directions,
        forces=None if None in forces else torch.tensor(forces, dtype=torch.float32),
        before=before,
        after=after,
    )
    return impacts, remarks


@dataclass
class Preprocessed:
    """What could be read of a capture folder, and what is wrong with it."""

    rows: list[Row]
    warnings: list[CaptureWarning]
    collect: bool
    """Whether errors are kept, and not raised."""
    errors: list[CaptureError] = field(default_factory=list)
    row_errors: dict[int, CaptureError] = field(default_factory=dict)
    """Errors of single recordings, by their lines in the table."""
    strikes: dict[int, Strike] = field(default_factory=dict)
    """The rows that can be parsed, by their lines."""
    reports: dict[int, RecordingReport] = field(default_factory=dict)
    """On the recordings that can be read, by their lines."""
    sounds: dict[int, Prepared] = field(default_factory=dict)
    """These recordings, as far as they are used."""
    surface: Surface | None = None
    """The part of it that the contacts lie on."""
    impacts: Impacts | None = None

    @contextmanager
    def keep(self, line: int | None = None) -> Iterator[None]:
        """Keep an error, of the capture or of one row of its table, or raise it."""
        try:
            yield
        except CaptureError as error:
            if not self.collect:
                raise
            if line is None:
                self.errors.append(error)
            else:
                self.row_errors[line] = error


def preprocess(folder: Path, settings: CaptureSettings, *, collect: bool = False) -> Preprocessed:
    """Read a capture folder; what is wrong with it is raised, or with `collect` kept.

    Raises `CaptureError` for a table that cannot be read in any case.
    """
    found = Preprocessed(*read_rows(folder), collect)
    for row in found.rows:
        with found.keep(row.line):
            found.strikes[row.line] = parse_row(row, settings)
    strikes = list(found.strikes.values())
    if strikes:
        with found.keep():
            refuse_repeated_files(strikes)
        with found.keep():
            refuse_missing(folder, strikes)
        found.warnings += check_contacts(strikes, settings)
    with found.keep():
        found.surface = find_surface(folder, settings)
        if found.surface is not None and strikes:
            found.warnings += check_surface(strikes, found.surface, settings=settings)
            contacts = torch.tensor([strike.contact for strike in strikes])
            found.surface, _ = contacted_part(found.surface, contacts)
    for line, strike in found.strikes.items():
        with found.keep(line):
            # Reading would name similar files, for which it compares up to a thousand names.
            if is_missing(folder / strike.file):
                raise CaptureError.expected("a sound file", file=strike.file)
            advice = f"copy it there, or remove its row from {TABLE}"
            recording = read_recording(folder / strike.file, strike.file, advice=advice)
            prepared = prepare(recording, settings, newtons=strike.newtons)
            found.reports[line] = measure(recording, prepared, settings=settings, line=line)
            found.sounds[line] = shorten(prepared, settings)
    _join(found, settings)
    return found


def _join(found: Preprocessed, settings: CaptureSettings) -> None:
    """Make impacts of the recordings that can be read, and compare them."""
    strikes, sounds = [found.strikes[line] for line in found.sounds], list(found.sounds.values())
    if not sounds:
        return
    names, directions = [strike.file for strike in strikes], [strike.direction for strike in strikes]
    with found.keep():
        found.warnings += check_levels([sound.peak for sound in sounds], names)
    with found.keep():
        found.impacts, warned = build_impacts(
            sounds,
            torch.tensor([strike.contact for strike in strikes], dtype=torch.float64),
            names=names,
            settings=settings,
            directions=None if None in directions else torch.tensor(directions, dtype=torch.float32),
        )
        found.warnings += warned


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
    folder = Path(folder)
    try:
        settings = settings or settings_of(folder)
        found = preprocess(folder, settings, collect=True)
    except CaptureError as error:
        return CaptureReport(False, (), (str(error),))
    reports = [found.reports.get(row.line) or _unreadable(row, found) for row in found.rows]
    far = [error for error in found.row_errors.values() if error.name == "unit"]
    if len(far) > 1:
        # One message for all, with which they are listed together.
        largest = max(abs(value) for error in far for value in error.value)
        words = (
            f"expected a contact within {FARTHEST:g} m of the origin, got coordinates of up to {largest:g} "
            f"(unit = {settings.unit!r}): {fitting_units(largest)}"
        )
        lines = [line for line, error in found.row_errors.items() if error in far]
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
    readable = not found.errors and all(report.readable for report in reports)
    problems = [*map(str, found.errors), *map(str, found.warnings), *_copies(found), *_unlisted(folder, set(names))]
    return CaptureReport(readable, tuple(reports), tuple(problems), tuple(remarks))


def _unreadable(row: Row, found: Preprocessed) -> RecordingReport:
    strike = found.strikes.get(row.line)
    file = row.cells["file"] if strike is None else strike.file
    return RecordingReport(file=file, line=row.line, readable=False, problems=(str(found.row_errors[row.line]),))


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
