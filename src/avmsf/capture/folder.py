"""A capture folder: `impacts.csv`, its wav files, perhaps `capture.toml` and a surface; read, checked and written."""

import json
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path, PurePosixPath

import torch

from avmsf._utils.files import new_folder
from avmsf._utils.text import counted, csv_text, in_order, listed
from avmsf.capture.audio import Recording, read_recording, wav_bytes
from avmsf.capture.checks import check_contacts, check_surface, find_surface
from avmsf.capture.filenames import files_in
from avmsf.capture.impacts import Impacts
from avmsf.capture.issues import Issues, RecordingReport, shared_problems
from avmsf.capture.preprocess import check_levels, preprocess
from avmsf.capture.settings import SETTINGS, TABLE, CaptureSettings, settings_of
from avmsf.capture.table import DIRECTION, FORCE, REQUIRED, Impact, in_folder, is_inside, present_impacts, read_impacts
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface

UNCUT = "all recordings start with the impact, as impulse responses do, and are not cut"
TEXT_ORDER = (
    f"the rows of {TABLE} have the files in the order of text (1, 10, 2), not of numbers (1, 2, 10): make sure that "
    "the contacts are in this order, too"
)


@dataclass(frozen=True, eq=False)
class Capture:
    """The recorded impacts on one object, with its surface."""

    name: str
    impacts: Impacts
    surface: Surface | None = None
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """Settings with which its folder was read."""
    folder: Path | None = None
    """Folder that it was read from, which may hold photographs, a video or Gaussians."""

    def __post_init__(self) -> None:
        wanted = "Impacts and perhaps a Surface, as in Capture(name, impacts, surface)"
        for name, kind in (("impacts", Impacts), ("surface", Surface | None)):
            if not isinstance(value := getattr(self, name), kind):
                raise CaptureError.expected(wanted, type(value).__name__, name=name)

    def __repr__(self) -> str:
        surface = "no surface" if self.surface is None else repr(self.surface)
        return f"Capture({self.name!r}, {self.impacts}, {surface})"

    def __len__(self) -> int:
        """Return the number of impacts."""
        return len(self.impacts)

    @property
    def sample_rate(self) -> float:
        """Samples per second of the recordings, Hz."""
        return self.impacts.sample_rate

    def write(self, folder: str | Path) -> None:
        """Write a folder that is read back to the same values, see `write_capture`."""
        write_capture(self, folder)


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


def read_capture(folder: str | Path, settings: CaptureSettings | None = None) -> Capture:
    """Read a capture folder; `settings`, where given, take the place of the folder's `capture.toml`.

    Every sound starts at its impact, is divided by its force where that is known, and has the length and the sample
    rate of all others (see `CaptureSettings`); nothing is resampled. With `align`, the samples on either side of the
    sounds are included for their alignment with one another (`Impacts.before`, `after`), and recordings that all start
    with the impact are not cut (`start_with_impact`). The order is that of `impacts.csv`. Raises `CaptureError` at the
    first input that cannot be used, and warns with `CaptureWarning` of what is usable but probably wrong; `check` lists
    everything.
    """
    folder, issues = Path(folder), Issues()
    with in_folder(folder):
        settings = settings or settings_of(folder)
        impacts, surface = _walk(folder, settings, issues)
    assert impacts is not None
    if wrong := [report for report in issues.reports if report.problems]:
        found = f"{len(wrong)} of {len(issues.reports)} recordings {'looks' if len(wrong) == 1 else 'look'} wrong"
        message = f"{found}: {listed(shared_problems(wrong), separator='; ')}. `avmsf check {folder}` shows all"
        issues.warnings.append(CaptureWarning(message, file=folder, value=[report.file for report in wrong]))
    for warning in issues.warnings:
        warnings.warn(warning, stacklevel=2)
    return Capture(settings.name or folder.resolve().name, impacts, surface, settings, folder)


def check(folder: str | Path, settings: CaptureSettings | None = None) -> CaptureReport:
    """Check a capture folder as `read_capture` would and report on every recording; raises nothing for bad input."""
    return check_and_read(folder, settings)[0]


def check_and_read(
    folder: str | Path, settings: CaptureSettings | None = None
) -> tuple[CaptureReport, Impacts | None, list[CaptureWarning]]:
    """Return the report of `check`, the impacts where the folder is readable, and the warnings among the problems."""
    folder, issues = Path(folder), Issues(collect=True)
    try:
        settings = settings or settings_of(folder)
        impacts, _ = _walk(folder, settings, issues)
    except CaptureError as error:
        return CaptureReport(False, (), (str(error),)), None, []
    reports, remarks = sorted(issues.reports, key=lambda report: report.line), []
    if issues.uncut:
        reports = [each if each.onset_seconds is None else replace(each, onset_seconds=0.0) for each in reports]
        remarks.append(UNCUT)
    names = [report.file for report in reports]
    if names == sorted(names) != list(in_order(names)):
        remarks.append(TEXT_ORDER)
    problems = [*map(str, issues.errors), *map(str, issues.warnings), *_copies(issues), *_unlisted(folder, set(names))]
    readable = not issues.errors and all(each.readable for each in reports)
    report = CaptureReport(readable, tuple(reports), tuple(problems), tuple(remarks))
    return report, impacts if readable else None, issues.warnings


def _walk(folder: Path, settings: CaptureSettings, issues: Issues) -> tuple[Impacts | None, Surface | None]:
    """Return the impacts and the part of the surface that they lie on; add to what is wrong."""
    listed_impacts, surface = read_impacts(folder, settings, issues), None
    issues.warnings += check_contacts(listed_impacts, settings)
    with issues.keep():
        surface = find_surface(folder, settings)
        if surface is not None and listed_impacts:
            surface, warned = check_surface(listed_impacts, surface, settings=settings)
            issues.warnings += warned
    impacts, _ = preprocess(read_recordings(folder, listed_impacts, issues), settings, issues)
    with issues.keep():
        issues.warnings += check_levels(issues.sounds)
    return impacts, surface


def read_recordings(folder: Path, impacts: Sequence[Impact], issues: Issues) -> Iterator[tuple[Impact, Recording]]:
    """Read the recordings of impacts one after the other; `issues` raise or collect what is wrong with them."""
    for each in present_impacts(folder, impacts, issues):
        recording = None
        with issues.keep((each.file, each.line)):
            recording = read_recording(folder / each.file, each.file)
        if recording is not None:
            yield each, recording


def _copies(issues: Issues) -> list[str]:
    """Return a sentence for each sound that is another one's copy."""
    first, sentences = dict[tuple[bytes, float], str](), []
    for file, sound in issues.sounds.items():
        original = first.setdefault(sound, file)
        if original != file:
            advice = "copy the right file, or remove its row"
            sentences.append(f"{file}: the same sound as {original}, to the last bit: {advice}")
    return sentences


def _unlisted(folder: Path, names: Collection[str]) -> list[str]:
    """Return a sentence on wav files without a row; hidden ones, such as what the studio has removed, are left out."""
    found = (path.relative_to(folder).as_posix() for path in files_in(folder) if path.suffix.lower() == ".wav")
    unlisted = [name for name in found if name not in names]
    verb = "has" if len(unlisted) == 1 else "have"
    return [f"{counted(len(unlisted), 'wav file')} {verb} no row in {TABLE}: {listed(unlisted)}"] if unlisted else []


def write_capture(capture: Capture, folder: str | Path, *, onsets_within: float | None = None) -> None:
    """Write a folder that `read_capture` reads back to the same values, bit for bit where onsets are found again.

    Sounds become float32 wav files under the recordings' names where these are wav paths inside a folder, else under
    numbers. Everything is written to a temporary folder first and then renamed into place: a folder of this name is
    complete or absent. With `onsets_within` the sounds are whole recordings that start before their impacts: reading
    then finds the onsets, and keeps this many seconds from each on. Sounds that may still be moved are written with
    what their files hold around them, so that their onsets are found anew, in loud noise not always at the same sample;
    others are not aligned when they are read. Raises `CaptureError` where the folder exists and is not empty, or cannot
    be written.
    """
    impacts, read_by, names = capture.impacts, capture.settings, _file_names(capture.impacts.names)
    # Starts that a hammer's channel told are not found anew without it.
    found = read_by.force_channel is None and impacts.before is not None
    sounds, final = list(impacts.sounds), onsets_within is None and not found
    # A field of sounds that start at their peaks locates recordings from their peaks on.
    peaks = final and read_by.from_peaks and not bool(impacts.sounds.abs().argmax(1).any())
    if not final and impacts.before is not None and impacts.after is not None:
        whole = torch.cat([impacts.before, impacts.sounds, impacts.after], dim=1)
        sounds = [each[~each.isnan()] for each in whole]
    rate, speed = _whole_rate(impacts.sample_rate, read_by.playback_speed)
    parts = ((REQUIRED, impacts.contacts), (DIRECTION, impacts.directions), ((FORCE,), impacts.forces))
    known = {columns: each.reshape(len(impacts), -1) for columns, each in parts if each is not None}
    # Seventeen digits hold a float64 exactly.
    digits = [[f"{value:.17g}" for value in values] for values in torch.cat([*known.values()], dim=1).tolist()]
    rows = [[*chain(*known)], *([name, *cells] for name, cells in zip(names, digits, strict=True))]
    # TOML's strings are JSON's, but for the character 127.
    title = json.dumps(capture.name, ensure_ascii=False).replace("\x7f", "\\u007f")
    seconds = impacts.sounds.shape[1] / rate if onsets_within is None else onsets_within
    settings = (
        f"name = {title}\n"
        f"seconds = {seconds!r}\n"
        f"playback_speed = {speed!r}\n"
        f'normalize = "{"none" if impacts.forces is None else "done"}"\n'
        + ('time_zero = "peak"\n' if peaks else "align = false\n" if final else "")
        + ('surface_unit = "m"\n' if read_by.unit_stated else "")
        + (f"held = {json.dumps(read_by.held_at)}\n" if read_by.held else "")
    )
    with new_folder(Path(folder), raising=CaptureError) as begun:
        for name, sound in zip(names, sounds, strict=True):
            (begun / name).parent.mkdir(parents=True, exist_ok=True)
            # Soundfile's own error of a full disk does not say that it is full.
            (begun / name).write_bytes(wav_bytes(sound.numpy(), rate, file=Path(name)))
        (begun / TABLE).write_text(csv_text(rows), encoding="utf-8", newline="")
        (begun / SETTINGS).write_text(settings, encoding="utf-8")
        if capture.surface is not None:
            capture.surface.write(begun / "surface.ply")


def _file_names(names: tuple[str, ...]) -> list[str]:
    """Return the names where all can be files inside the folder, else numbers."""
    usable = all(
        name.lower().endswith(".wav") and name == name.strip() == str(PurePosixPath(name))
        and is_inside(PurePosixPath(name)) and "\\" not in name
        for name in names
    )  # fmt: skip
    if usable and len({name.lower() for name in names}) == len(names):
        return list(names)
    return [f"{number:03d}.wav" for number in range(1, len(names) + 1)]


def _whole_rate(sample_rate: float, speed: float) -> tuple[int, float]:
    """Return a whole rate for the files, close to the given one over the speed, and the speed that brings that back.

    A quotient times its divisor misses by one unit in the last place for one divisor in seven, so others are tried.
    """
    nearest = max(1, round(sample_rate / speed))
    rate = next(rate for rate in range(nearest, 2 * nearest + 64) if rate * (sample_rate / rate) == sample_rate)
    return rate, sample_rate / rate
