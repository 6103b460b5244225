"""`avmsf check`: what each recording of a capture is worth, and what is wrong."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from avmsf.capture import CaptureReport, CaptureSettings, check
from avmsf.capture.measure import shared_problems
from avmsf.cli.printing import console, decimals, print_json, say, table
from avmsf.wording import counted

UNREADABLE = 2
MAX_PRINTED = 1000
"""Rows, and sentences below them, of the printed report: what a terminal's scrollback holds."""


@dataclass(frozen=True)
class Options:
    """Say what each recording of a capture is worth, and what is wrong.

    One row a recording, problems below. The exit code is 0 where the capture can be read, with or without warnings,
    and 2 where it cannot.
    """

    capture: tyro.conf.Positional[Path]
    """Folder with impacts.csv and the wav files it names."""
    settings: Path | None = None
    """A capture.toml to use in place of the folder's own."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf check", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Print the report; return 2 where the capture cannot be read."""
    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    report = check(options.capture, settings)
    screen = console(errors=options.json)
    if report.recordings:
        screen.print(_table(report, str(options.capture)))
    problems = problems_of(report)
    for problem in problems[:MAX_PRINTED]:
        screen.print(problem, soft_wrap=True)
    if len(problems) > MAX_PRINTED:
        screen.print(f"and {len(problems) - MAX_PRINTED} more; --json prints all", soft_wrap=True)
    if options.json:
        print_json(asdict(report))
    if not report.readable:
        say(f"avmsf check: {options.capture} cannot be read as it is: mend what is listed and check again")
        return UNREADABLE
    for remark in report.remarks:
        screen.print(remark, soft_wrap=True)
    wrong = len(problems)
    screen.print("no problem found" if not wrong else f"readable, with {counted(wrong, 'warning')}", soft_wrap=True)
    return 0


def problems_of(report: CaptureReport) -> list[str]:
    """Return every problem as one sentence: the folder's first, then the recordings', what they share only once."""
    return [*report.problems, *shared_problems(report.recordings)]


def _table(report: CaptureReport, title: str) -> object:
    columns = ("recording", "state", "length s", "rate Hz", "peak dB", "noise dB", "clipped", "onset s", "2nd blow s")
    rows = [
        (
            row.file,
            "unreadable" if not row.readable else "look" if row.problems else "good",
            decimals(row.seconds, 2),
            decimals(row.sample_rate, 0),
            decimals(row.peak_db, 1),
            decimals(row.noise_db, 1),
            decimals(row.clipped, 0),
            decimals(row.onset_seconds, 4),
            decimals(row.double_hit_seconds, 3),
        )
        for row in report.recordings[:MAX_PRINTED]
    ]
    return table(title, columns, rows, words=2)
