"""What is wrong with a capture: raised at the first error, or collected in a report."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from avmsf._utils.text import listed
from avmsf.capture.settings import TABLE
from avmsf.errors import CaptureError, CaptureWarning


@dataclass(frozen=True)
class RecordingReport:
    """One row of `avmsf check`: plain values; those that could not be measured are None."""

    file: str
    line: int
    """Line of impacts.csv."""
    readable: bool
    """Whether the capture can be read with this recording in it."""
    problems: tuple[str, ...] = ()
    """What is wrong and what to do about it."""
    seconds: float | None = None
    """Length of the whole file, as recorded."""
    sample_rate: float | None = None
    """The file's own, Hz."""
    channels: int | None = None
    coding: str | None = None
    """PCM_16, FLOAT and so on."""
    peak_db: float | None = None
    """Peak of the response against full scale (against 1.0 in float files), dB."""
    noise_db: float | None = None
    """Noise (root mean square) against the peak, dB: before the impact, or else in the quietest tenth of the file."""
    onset_seconds: float | None = None
    """When the impact begins in the file, seconds as recorded."""
    clipped: int | None = None
    """Samples on flat tops, in the response and the force."""
    double_hit_seconds: float | None = None
    """When a second impact begins in the file, within the length that is used; None without one."""


@dataclass
class Issues:
    """What is wrong with a capture's recordings, and what was measured in them."""

    collect: bool = False
    """Whether errors are collected, and recordings that have one left out; else the first is raised."""
    errors: list[CaptureError] = field(default_factory=list)
    """Of the capture as a whole."""
    warnings: list[CaptureWarning] = field(default_factory=list)
    reports: list[RecordingReport] = field(default_factory=list)
    """On the recordings, whether they can be used or not."""
    sounds: dict[str, tuple[bytes, float]] = field(default_factory=dict)
    """Digest and peak of each usable one from its impact to the file's end, by its name."""
    uncut: bool = False
    """Whether all recordings start with the impact, and are not cut."""

    @contextmanager
    def keep(self, *recordings: tuple[str, int]) -> Iterator[None]:
        """Collect or raise an error of recordings, given by names and lines, or without these of the capture."""
        try:
            yield
        except CaptureError as error:
            if not self.collect:
                raise
            self.reports += [RecordingReport(file, line, False, (str(error),)) for file, line in recordings]
            self.errors += [] if recordings else [error]


def shared_problems(reports: Sequence[RecordingReport], *, most: int = 3) -> list[str]:
    """Return the recordings' problems, each with its file; common ones once, with the first names, `most` of them."""
    places: dict[str, list[str]] = {}
    for report in reports:
        for problem in report.problems:
            places.setdefault(problem.removeprefix(f"{report.file}: "), []).append(report.file)
    sentences = []
    for problem, files in places.items():
        where = f"{files[0]}: "
        if len(files) > 1:
            where = f"{len(files)} recordings ({listed(files, most=most)}): "
        # Errors of the table's reader say which rows they are about.
        sentences.append(problem if problem.startswith(TABLE) else f"{where}{problem}")
    return sentences
