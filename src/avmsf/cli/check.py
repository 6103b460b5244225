"""`avmsf check`: what each recording of a capture is worth, what a dataset holds, and what is wrong."""

from collections.abc import Sequence
from dataclasses import asdict

from rich.console import Console

from avmsf._utils.text import counted
from avmsf.capture import CaptureReport, CaptureSettings, Impacts
from avmsf.capture.folder import check_and_read
from avmsf.capture.issues import shared_problems
from avmsf.capture.proposals import Proposal, propose_settings, settings_text, write_settings
from avmsf.cli.alignment import AlignmentReport
from avmsf.cli.options.check import Options
from avmsf.cli.printing import console, decimals, doing, next_command, print_json, say, table
from avmsf.datasets import DatasetReport, ObjectReport, open_dataset
from avmsf.errors import CaptureError, ExtractionError
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.finders import HighResolution
from avmsf.pipeline.visuals import inputs, misplaced

UNREADABLE = 2
_STRONGEST = 32
"""Modes by which recordings of inverted polarity are found."""
MAX_PRINTED = 1000
"""Rows, and messages below them, of the printed report: as much as a terminal's scrollback holds."""


def run(options: Options) -> int:
    """Print the report; return 2 where the capture, or every object of a dataset, cannot be read."""
    if options.is_dataset:
        return _check_dataset(options)
    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    screen = console(errors=options.json)
    doing(f"reading {options.capture}")
    visual = inputs(options.capture, settings)
    outside = [] if visual is None else misplaced(options.capture, settings, visual)
    factor = next((each.value for each in outside if each.name == "unit"), None)
    proposals = propose_settings(options.capture, settings, factor=factor)
    if proposals and options.write_settings:
        _write(options, proposals, screen)
        if any(each.key == "unit" for each in proposals):
            outside = [each for each in outside if each.name != "unit"]
    report, impacts = check_and_read(options.capture, settings)
    doing("finding the modes that align the recordings")
    modes = None if impacts is None else _modes(impacts)
    aligned = None if modes is None or impacts is None else AlignmentReport.of(modes, impacts)
    if report.recordings:
        screen.print(_table(report, str(options.capture), aligned))
    if visual is not None:
        screen.print(visual.sentence, soft_wrap=True)
    # The folder's first, then the recordings', common ones once.
    problems = [*report.problems, *shared_problems(report.recordings)]
    problems += [] if visual is None else [*visual.problems, *visual.unused]
    problems += map(str, outside)
    hidden = len(problems) - MAX_PRINTED
    for problem in [*problems[:MAX_PRINTED], *([f"and {hidden} more; --json prints all"] if hidden > 0 else [])]:
        screen.print(problem, soft_wrap=True)
    if options.write_settings and not proposals:
        left = "; settings that the messages above name are yours to choose" if problems else ""
        screen.print(f"the folder's files determine no further setting: nothing was written{left}", soft_wrap=True)
    if not options.write_settings:
        for each in proposals:
            screen.print(f"proposed: {each.line} (--write-settings writes it). {each.reason}", soft_wrap=True)
    if options.json:
        print_json(
            {
                **asdict(report),
                "visual_inputs": None if visual is None else asdict(visual),
                "proposals": [asdict(each) for each in proposals],
                "alignment": None if aligned is None else asdict(aligned),
            }
        )
    if not report.readable:
        say(f"avmsf check: {options.capture} cannot be read; correct the errors above and check again")
        return UNREADABLE
    for sentence in (*(report.remarks if modes else ()), *(aligned.sentences() if aligned else ())):
        screen.print(sentence, soft_wrap=True)
    if modes is None:
        screen.print("no mode was found to align the recordings: noisy or too short (see avmsf modes)")
    wrong = len(problems) + (modes is None)
    if aligned is not None:
        wrong += bool(aligned.not_aligned) + bool(aligned.inverted) + len(aligned.faults())
    screen.print("no problem found" if not wrong else f"readable, with {counted(wrong, 'warning')}", soft_wrap=True)
    if visual is not None and visual.reconstructs:
        next_command("avmsf fit", options.capture, "-o field.safetensors")
    else:
        next_command("avmsf modes", options.capture)
    return 0


def _modes(impacts: Impacts) -> Extraction | None:
    """Return the strongest modes; None where there is no mode."""
    try:
        return extract_modes(impacts, HighResolution(modes=_STRONGEST))
    except ExtractionError:
        return None


def _write(options: Options, proposals: Sequence[Proposal], screen: Console) -> None:
    """Write the proposals and print them; raise `CaptureError` where they cannot be written."""
    try:
        path = write_settings(options.capture, proposals)
    except CaptureError:
        screen.print(settings_text(proposals), soft_wrap=True)
        raise
    screen.print(f"{path}: written, with {', '.join(each.line for each in proposals)}", soft_wrap=True)


def _table(report: CaptureReport, title: str, aligned: AlignmentReport | None) -> object:
    delays = {} if aligned is None else aligned.delays
    left = [] if aligned is None else aligned.not_aligned
    doubtful = [] if aligned is None else [*left, *aligned.inverted, *aligned.rate_factors, *aligned.gain_changes_db]
    # Short lines leave the width to the names of the recordings.
    levels = ["peak\ndBFS", "noise dB\nre peak"]
    columns = ["recording", "state", "length\ns", "rate\nHz", *levels, "clipped", "onset\ns", "second\nimpact s"]
    rows = [
        (
            row.file,
            "unreadable" if not row.readable else "warning" if row.problems or row.file in doubtful else "good",
            decimals(row.seconds, 2),
            decimals(row.sample_rate, 0),
            decimals(row.peak_db, 1),
            decimals(row.noise_db, 1),
            decimals(row.clipped, 0),
            decimals(row.onset_seconds, 4),
            decimals(row.double_hit_seconds, 3),
            *([decimals(None if row.file in left else delays.get(row.file), 2)] if delays else []),
        )
        for row in report.recordings[:MAX_PRINTED]
    ]
    return table(title, [*columns, "delay\nsamples"] if delays else columns, rows, words=2)


def _check_dataset(options: Options) -> int:
    """Print which objects of a dataset can be read, and what is missing; return 2 where none can be."""
    report = open_dataset(options.capture, contacts=options.contact_data).check()
    screen = console(errors=options.json)
    screen.print(_objects(report, f"{report.dataset} in {options.capture}"))
    for line in _lines(report):
        screen.print(line, soft_wrap=True)
    if options.json:
        print_json(asdict(report))
    readable = sum(_readable(each) for each in report.objects)
    if not readable:
        say(f"avmsf check: {options.capture}: expected a readable object, found none; fix the listed problems")
        return UNREADABLE
    recordings = sum(each.recordings for each in report.objects)
    screen.print(
        f"{readable} of {counted(len(report.objects), 'object')} can be read, with {counted(recordings, 'recording')}",
        soft_wrap=True,
    )
    next_command("avmsf evaluate farthest", options.capture)
    return 0


def _readable(report: ObjectReport) -> bool:
    return report.recordings >= 2


def _lines(report: DatasetReport) -> list[str]:
    """Return what is not in the table, a line each: missing parts, then problems, then remarks."""
    problems = [f"{each.facts.identifier}: {problem}" for each in report.objects for problem in each.problems]
    return [*(f"missing: {part}" for part in report.missing), *problems, *(f"note: {each}" for each in report.remarks)]


def _objects(report: DatasetReport, title: str) -> object:
    rows = []
    for each in report.objects:
        facts = each.facts
        inferred = " (inferred)" * facts.inferred
        rows.append(
            (
                facts.identifier,
                "unreadable" if not _readable(each) else "incomplete" if each.problems else "good",
                "–" if facts.name == facts.identifier else facts.name + inferred,
                "–" if facts.material is None else facts.material + inferred,
                str(each.recordings),
            )
        )
    return table(title, ("object", "state", "name", "material", "recordings"), rows, words=4)
