"""A capture folder: `impacts.csv`, its wav files, perhaps `capture.toml` and a surface; read and written whole."""

import csv
import warnings
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import torch

from avmsf._utils.files import new_folder
from avmsf.capture.audio import wav_bytes
from avmsf.capture.impacts import Impacts
from avmsf.capture.measure import RecordingReport, shared_problems, shortened
from avmsf.capture.preprocess import preprocess
from avmsf.capture.settings import SETTINGS, CaptureSettings, settings_of
from avmsf.capture.table import DIRECTION, FORCE, REQUIRED, TABLE, in_folder
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface, write_surface


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

    def __repr__(self) -> str:
        surface = "no surface" if self.surface is None else repr(self.surface)
        return f"Capture({self.name!r}, {self.impacts}, {surface})"

    def write(self, folder: str | Path) -> None:
        """Write a folder that is read back to the same values, see `write_capture`."""
        write_capture(self, folder)


def read_capture(folder: str | Path, settings: CaptureSettings | None = None) -> Capture:
    """Read a capture folder; `settings`, where given, take the place of the folder's `capture.toml`.

    Every sound starts at its impact, is divided by its force where that is known, and has the length and the sample
    rate of all others (see `CaptureSettings`); nothing is resampled. With `align`, the samples on either side of the
    sounds are included for their alignment with one another (`Impacts.before`, `after`), and recordings that all start
    with the impact are not cut (`start_with_impact`). The order is that of `impacts.csv`. Raises `CaptureError` at the
    first input that cannot be used, and warns with `CaptureWarning` of what is usable but probably wrong; `check` lists
    everything.
    """
    folder = Path(folder)
    with in_folder(folder):
        settings = settings or settings_of(folder)
        found = preprocess(folder, settings)
    assert found.impacts is not None
    for remark in found.warnings + _summary(list(found.reports.values()), folder):
        warnings.warn(remark, stacklevel=2)
    return Capture(settings.name or folder.resolve().name, found.impacts, found.surface, settings, folder)


def write_capture(capture: Capture, folder: str | Path, *, onsets_within: float | None = None) -> None:
    """Write a folder that `read_capture` reads back to the same values, bit for bit.

    Sounds become float32 wav files under the recordings' names where these are wav paths inside a folder, else under
    numbers. Everything is written to a temporary folder first and then renamed into place: a folder of this name is
    complete or absent. With `onsets_within` the sounds are whole recordings that start before their impacts: reading
    then finds the onsets, and keeps this many seconds from each on; without it they are final, and are not aligned when
    they are read. Raises `CaptureError` where the folder exists and
    is not empty, or cannot be written.
    """
    folder = Path(folder)
    with new_folder(folder, raising=CaptureError) as begun:
        _write_files(capture, begun, onsets_within=onsets_within)


def _write_files(capture: Capture, folder: Path, *, onsets_within: float | None) -> None:
    impacts = capture.impacts
    names = _file_names(impacts.names)
    rate, speed = _whole_rate(impacts.sample_rate)
    for name, sound in zip(names, impacts.sounds.numpy(), strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        # Soundfile's own error of a full disk does not say that it is full.
        (folder / name).write_bytes(wav_bytes(sound, rate))
    header, columns = list(REQUIRED), [impacts.contacts]
    if impacts.directions is not None:
        header, columns = [*header, *DIRECTION], [*columns, impacts.directions]
    if impacts.forces is not None:
        header, columns = [*header, FORCE], [*columns, impacts.forces[:, None]]
    with open(folder / TABLE, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(header)
        # Seventeen digits hold a float64 exactly.
        for name, values in zip(names, torch.cat(columns, dim=1).tolist(), strict=True):
            table.writerow([name, *(f"{value:.17g}" for value in values)])
    if capture.surface is not None:
        write_surface(capture.surface, folder / "surface.ply")
    name = "".join(
        f"\\u{ord(mark):04x}" if mark in '"\\' or ord(mark) in (*range(32), 127) else mark for mark in capture.name
    )
    seconds = impacts.sounds.shape[1] / rate if onsets_within is None else onsets_within
    (folder / SETTINGS).write_text(
        f'name = "{name}"\n'
        f"seconds = {seconds!r}\n"
        f"playback_speed = {speed!r}\n"
        f'normalize = "{"none" if impacts.forces is None else "done"}"\n'
        + ("align = false\n" if onsets_within is None else ""),
        encoding="utf-8",
    )


def _file_names(names: tuple[str, ...]) -> list[str]:
    """Return the names where all can be files inside the folder, else numbers."""
    paths = [PurePosixPath(name) for name in names]
    usable = all(
        path.suffix.lower() == ".wav" and str(path) == name and not path.is_absolute() and ".." not in path.parts
        and "\\" not in name and ":" not in path.parts[0] and name == name.strip()
        for path, name in zip(paths, names, strict=True)
    )  # fmt: skip
    if usable and len({name.lower() for name in names}) == len(names):
        return list(names)
    return [f"{number:03d}.wav" for number in range(1, len(names) + 1)]


def _whole_rate(sample_rate: float) -> tuple[int, float]:
    """Return a whole rate for the files, close to the given one, and the playback speed that brings that back exactly.

    A quotient times its divisor misses by one unit in the last place for one divisor in seven, so others are tried.
    """
    nearest = max(1, round(sample_rate))
    rate = next(rate for rate in range(nearest, 2 * nearest + 64) if rate * (sample_rate / rate) == sample_rate)
    return rate, sample_rate / rate


def _summary(reports: list[RecordingReport], folder: Path) -> list[CaptureWarning]:
    wrong = [report for report in reports if report.problems]
    if not wrong:
        return []
    found = f"{len(wrong)} of {len(reports)} recordings {'looks' if len(wrong) == 1 else 'look'} wrong"
    message = f"{found}: {shortened(shared_problems(wrong))}. `avmsf check {folder}` shows all"
    return [CaptureWarning(message, file=folder, value=[report.file for report in wrong])]
