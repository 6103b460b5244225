"""`avmsf check`: what each recording of a capture is worth, what a dataset holds, and what is wrong."""

import shlex
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from avmsf._utils.text import counted
from avmsf.capture.settings import SETTINGS, TABLE, settings_of
from avmsf.capture.table import read_rows
from avmsf.cli.options import Common, Flag
from avmsf.cli.output import command, decimals, doing, finish, say, show, table
from avmsf.cli.paths import ContactData, Existing
from avmsf.datasets.detect import detect_dataset
from avmsf.errors import AvmsfError, AvmsfWarning, CaptureError, ExtractionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from avmsf.capture import CaptureReport
    from avmsf.capture.proposals import Proposal
    from avmsf.modal.extraction.alignment_report import AlignmentReport
    from avmsf.pipeline.visual_checks import VisualInputs

UNREADABLE = 2
_STRONGEST = 32
"""Modes by which recordings of inverted polarity are found."""
_UNITS = ("unit", "surface_unit", "views_unit")
"""Settings without which `avmsf fit` refuses, where they are proposed."""
_MEASURED = {
    "length (s)": ("seconds", 2),
    "rate (Hz)": ("sample_rate", 0),
    "peak (dBFS)": ("peak_db", 1),
    "noise (dB)": ("noise_db", 1),
    "clipped": ("clipped", 0),
    "onset (s)": ("onset_seconds", 4),
    "second impact (s)": ("double_hit_seconds", 3),
}
"""Columns of the table, what they are of a recording's report, and decimals."""


@dataclass(frozen=True)
class Options(Common):
    """Check the recordings of a capture: levels, noise, clipping, onsets, second impacts and alignment.

    Prints one row per recording and the problems below. The peak is relative to full scale, the noise (root mean
    square) to the recording's own peak. The delay, in samples, aligns a recording with the others. The exit code is 0
    if the capture can be read, with or without warnings, and 2 if it cannot.

    Of a dataset (ObjectFolder Real, RealImpact, or a folder of captures) the objects are listed instead: what can be
    read, and what is missing; sounds are not read. The exit code is then 0 if at least one object can be read.
    """

    capture: tyro.conf.Positional[
        Annotated[Path, tyro.conf.arg(metavar="CAPTURE|DATASET"), Existing("a capture or a dataset", ("a folder",))]
    ]
    """Folder with impacts.csv and the recordings that it names, or of a dataset."""
    write_settings: Flag = False
    """Write the proposed settings, with the reasons, to the folder's capture.toml, and check with them. An existing
    capture.toml is not changed."""
    contact_data: ContactData = None
    """ObjectFolder Real's contacts: SonicGauss's lists in a folder, or one of them."""

    @property
    def is_dataset(self) -> bool:
        """Whether the folder is a dataset: it holds captures, or no recordings itself."""
        captures, recordings = (any(self.capture.glob(pattern)) for pattern in (f"[!.]*/{TABLE}", "*.wav"))
        return not (self.capture / TABLE).is_file() and (captures or not recordings)

    @property
    def how(self) -> str:
        """How a proposed setting gets into the capture."""
        return f"add it to {SETTINGS}" if (self.capture / SETTINGS).exists() else "--write-settings writes it"

    def _check(self) -> None:
        if self.is_dataset:
            detect_dataset(self.capture)
            if self.write_settings:
                wanted = "a capture with it"
                raise CaptureError.expected(wanted, "a dataset", file=self.capture, name="--write-settings")
        elif not self.json:
            # JSON reports also what is wrong with the folder as a whole.
            settings_of(self.capture)
            read_rows(self.capture)


def run(options: Options) -> int:
    """Print the report; return 2 where the capture, or every object of a dataset, cannot be read."""
    from avmsf.capture.folder import check_and_read
    from avmsf.capture.issues import shared_problems
    from avmsf.modal.extraction.alignment_report import AlignmentReport
    from avmsf.modal.extraction.extract import extract_modes
    from avmsf.modal.extraction.finders import HighResolution
    from avmsf.pipeline.visual_checks import inputs

    if options.is_dataset:
        return _check_dataset(options)
    doing(f"reading {options.capture}")
    visual = inputs(options.capture)
    proposals, wrong = _propose(options, visual)
    report, impacts, warned = check_and_read(options.capture)
    doing("finding the modes that align the recordings")
    modes = None
    with suppress(ExtractionError):
        modes = None if impacts is None else extract_modes(impacts, HighResolution(modes=_STRONGEST))
    aligned = None if modes is None or impacts is None else AlignmentReport.of(modes, impacts)
    measured = any(each.seconds is not None for each in report.recordings)
    # The folder's first, then the recordings', common ones once; with the names of all where no table shows them.
    most = 3 if measured else len(report.recordings)
    problems = [*report.problems, *shared_problems(report.recordings, most=most)]
    lines = [_table(report, str(options.capture), aligned)] if measured else []
    if visual is not None:
        problems += [*visual.problems, *visual.unused, *map(str, wrong)]
        lines.append(visual.sentence)
    # A unit that is proposed is one problem, whatever else says that it is wrong.
    units = [] if options.write_settings else [each for each in proposals if each.key in _UNITS]
    of_units = {str(each) for each in [*warned, *wrong] if units and each.name in _UNITS}
    said = {str(each) for each in warned} & of_units
    lines += [each for each in problems if each not in said]
    if not options.write_settings:
        for reason, group in groupby(proposals, lambda each: each.reason):
            lines.append(f"proposed: {', '.join(each.line for each in group)} ({options.how}). {reason}")
    elif not proposals:
        left = "; settings that the messages above name are yours to choose" if problems else ""
        lines.append(f"the folder's files determine no further setting: nothing was written{left}")
    values = {
        **asdict(report),
        "visual_inputs": None if visual is None else asdict(visual),
        "proposals": [asdict(each) for each in proposals],
        "alignment": None if aligned is None else asdict(aligned),
    }
    if not report.readable:
        show("\n".join(lines))
        say(f"avmsf check: {options.capture} cannot be read; correct the errors above and check again", always=True)
        needed = () if options.write_settings else proposals
        steps = [_next_command(options, needed, visual, wrong)] if needed else []
        return finish("", values, *steps, code=UNREADABLE)
    said_of_modes = [*report.remarks, *(aligned.sentences() if aligned else ())]
    if modes is None:
        said_of_modes = ["no mode was found to align the recordings: noisy or too short (see avmsf modes)"]
    count = sum(each not in of_units for each in problems) + bool(units) + (modes is None)
    count += 0 if aligned is None else len(aligned.warnings())
    said_of_modes.append(f"readable, with {counted(count, 'warning')}" if count else "no problem found")
    return finish("\n".join([*lines, *said_of_modes]), values, _next_command(options, units, visual, wrong))


def _propose(
    options: Options, visual: "VisualInputs | None"
) -> "tuple[tuple[Proposal, ...], list[AvmsfWarning | AvmsfError]]":
    """Return the settings that would help, written if asked for, and what then shows the object elsewhere."""
    from avmsf.capture.proposals import propose_settings, write_settings
    from avmsf.pipeline.visual_checks import misplaced

    wrong = [] if visual is None else misplaced(options.capture, visual)
    proposals = propose_settings(options.capture, wrong)
    if proposals and options.write_settings:
        path = write_settings(options.capture, proposals)
        show(f"{path}: written, with {', '.join(each.line for each in proposals)}")
        wrong = [] if visual is None else misplaced(options.capture, visual)
    return proposals, wrong


def _next_command(
    options: Options,
    needed: "Sequence[Proposal]",
    visual: "VisualInputs | None",
    wrong: "Sequence[AvmsfWarning | AvmsfError]",
) -> str:
    """Return what is to do next: set what is needed, correct what is wrong with photographs, or go on."""
    capture, path = shlex.quote(str(options.capture)), options.capture / SETTINGS
    if needed and path.exists():
        return f"add {' and '.join(each.line for each in needed)} to {path}, then avmsf check {capture}"
    if needed:
        return f"avmsf check {capture} --write-settings"
    if visual is None or not visual.reconstructs:
        return f"avmsf modes {capture}"
    if any(isinstance(each, AvmsfError) for each in wrong):
        return f"correct what is said of the photographs, then avmsf check {capture}"
    return f"avmsf fit {capture} -o field.safetensors"


def _table(report: "CaptureReport", title: str, aligned: "AlignmentReport | None") -> str:
    """Return a row for each recording: its state, what was measured, and by how many samples it was moved."""
    delays = {} if aligned is None else {**aligned.delays, **dict.fromkeys(aligned.not_aligned)}
    doubtful = set() if aligned is None else aligned.doubtful
    rows = []
    for row in report.recordings:
        state = "error" if not row.readable else "warning" if row.problems or row.file in doubtful else "good"
        measured = [decimals(getattr(row, name), places) for name, places in _MEASURED.values()]
        rows.append([row.file, state, *measured, *([decimals(delays.get(row.file), 2)] if delays else [])])
    columns = ["recording", "state", *_MEASURED, *(["delay (samples)"] if delays else [])]
    return table(title, columns, rows, words=2)


def _check_dataset(options: Options) -> int:
    """Print which objects of a dataset can be read, and what is missing; return 2 where none can be."""
    from avmsf.datasets import open_dataset

    report = open_dataset(options.capture, contacts=options.contact_data).check()
    rows, readable = [], 0
    for each in report.objects:
        facts, usable = each.facts, each.recordings >= 2
        inferred, readable = " (inferred)" * facts.inferred, readable + usable
        state = "unreadable" if not usable else "incomplete" if each.problems else "good"
        name = "–" if facts.name == facts.identifier else facts.name + inferred
        material = "–" if facts.material is None else facts.material + inferred
        rows.append((facts.identifier, state, name, material, str(each.recordings)))
    columns = ("object", "state", "name", "material", "recordings")
    problems = [f"{each.facts.identifier}: {problem}" for each in report.objects for problem in each.problems]
    lines = [f"missing: {part}" for part in report.missing] + problems + [f"note: {each}" for each in report.remarks]
    show("\n".join([table(f"{report.dataset} in {options.capture}", columns, rows, words=4), *lines]))
    if not readable:
        wanted = "expected a readable object, found none; fix the listed problems"
        say(f"avmsf check: {options.capture}: {wanted}", always=True)
        return finish("", asdict(report), code=UNREADABLE)
    recordings = counted(sum(each.recordings for each in report.objects), "recording")
    text = f"{readable} of {counted(len(report.objects), 'object')} can be read, with {recordings}"
    return finish(text, asdict(report), command("avmsf evaluate farthest", options.capture))
