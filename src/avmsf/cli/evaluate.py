"""`avmsf evaluate`: the errors of methods on a dataset, as tables and as a page."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from avmsf._utils.text import counted
from avmsf.cli.options import Configured, Device, Flag
from avmsf.cli.output import command, display, finish, note, say, table
from avmsf.cli.paths import CacheFolder, ContactData, Existing, OutputFolder, arg
from avmsf.datasets.detect import detect_dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import PROTOCOLS, EvaluationSettings, expect_suited, protocol_named, suited_methods
from avmsf.pipeline.config import TimeZero, ViewsConfig

if TYPE_CHECKING:
    from avmsf.evaluation.registry import Protocol
    from avmsf.evaluation.tables import Section
    from avmsf.evaluation.task import Method

FAILED = 1
"""The exit code where methods or objects failed and others have results."""
_Names = Annotated[tuple[str, ...], arg("NAMES")]


@dataclass(frozen=True)
class Options(Configured):
    """Evaluate methods at held-out contacts, on all objects of a dataset.

    The results are summary.json, report.md and report.html, which plays sounds.
    """

    protocol: tyro.conf.Positional[
        Annotated[str, tyro.conf.arg(metavar="PROTOCOL", help=f"{', '.join(PROTOCOLS)}; `NAME --help` explains it.")]
    ]
    data: tyro.conf.Positional[
        Annotated[
            Path, tyro.conf.arg(metavar="DATA"), Existing("a dataset, capture folders or one capture", ("a folder",))
        ]
    ]
    """A dataset, a folder of captures, or one."""
    methods: _Names = ()
    """Methods, by commas or blanks; by default the protocol's."""
    objects: _Names = ()
    """Objects, likewise."""
    output: OutputFolder = None
    """Results, by default evaluation/DATASET/PROTOCOL."""
    cache: CacheFolder = None
    """Features, which several evaluations may share."""
    test: Annotated[tuple[str, ...], arg("NAMES")] = ()
    """predefined: recordings to test on, such as 009.wav."""
    counts: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (16, 8, 4, 2, 1)
    """shots: numbers of training contacts."""
    starts: int = 1
    """shots: number of first contacts."""
    visual_source: Annotated[Literal["best", "mesh"], arg("best|mesh")] = "best"
    """Features of photographs, if any, or of the mesh."""
    workers: int = 1
    """Objects at a time, on one thread each."""
    ray: Annotated[str | None, arg("ADDRESS")] = None
    """A ray cluster with the same paths; needs `scale`."""
    seed: int = 0
    """Seed of all methods."""
    device: Device = None
    """For views and training; by default the GPU."""
    no_cdpam: Flag = False
    """Leave out CDPAM, which needs the extra `eval`."""
    cdpam_contacts: int = 8
    """Test contacts per case for CDPAM; 0 for all."""
    time_zero: Annotated[TimeZero | None, arg("onset|peak")] = None
    """Start of the scored sounds; peak: as the paper."""
    contact_data: ContactData = None
    """ObjectFolder Real's contacts: SonicGauss's lists."""
    figures: Annotated[tyro.conf.FlagCreatePairsOff[bool], arg("", "--plots")] = False
    """Also draw spectrograms, and heat maps with localize."""

    usual = EvaluationSettings()

    @classmethod
    def parse(cls, words: Sequence[str]) -> "Options":
        """Return the options as `Configured`; a help that names a protocol begins with what it does."""
        named = [word for word in words if word in PROTOCOLS][:1]
        for name in named if {"-h", "--help"} & {*words} else ():
            known, usual = (", ".join(names) for names in (suited_methods(name), PROTOCOLS[name].methods))
            for text in (f"{name}: {PROTOCOLS[name].title}", f"Methods: {known}; by default {usual}."):
                print(textwrap.fill(text, 80, break_on_hyphens=False), end="\n\n")
        return super().parse(words)

    def _check(self) -> None:
        protocol_named(self.protocol)
        for name in words_of(self.methods):
            expect_suited(name, self.protocol)
        if self.protocol == "predefined" and not self.test:
            wanted, advice = "names of the recordings to test on", "such as --test 009.wav,010.wav"
            raise EvaluationError.expected(wanted, name="--test", advice=advice)
        if self.protocol == "shots" and min(self.counts, default=0) < 1:
            raise EvaluationError.expected("numbers of contacts of 1 or more", list(self.counts), name="counts")
        if self.protocol == "shots" and self.starts < 1:
            raise EvaluationError.expected("1 start or more", self.starts, name="starts")
        _ = self.all_settings
        detect_dataset(self.data)


def words_of(given: Sequence[str]) -> tuple[str, ...]:
    """Return words that commas or blanks separate."""
    return tuple(word for each in given for word in each.split(",") if word)


def run(options: Options) -> int:
    """Evaluate, and print the results; what is done is kept where it is interrupted."""
    from avmsf.datasets import open_dataset
    from avmsf.evaluation.methods import method_named
    from avmsf.evaluation.objects import SUBSETS, choose_objects, members
    from avmsf.evaluation.plan import dataset_title, plan_evaluation
    from avmsf.evaluation.registry import MetricSettings
    from avmsf.evaluation.report import PAGE, write_figures, write_page, write_summary
    from avmsf.evaluation.results import IDENTITY, ResultsFolder
    from avmsf.evaluation.runner import run_objects

    protocol = _protocol_of(options)
    methods = tuple(method_named(name) for name in words_of(options.methods) or protocol.methods)
    # All paths are made absolute: workers may run in folders of their own.
    contacts = None if options.contact_data is None else options.contact_data.resolve()
    opened = partial(open_dataset, options.data.resolve(), contacts=contacts)
    dataset = opened(time_zero=options.time_zero)
    title = dataset_title(dataset, options.data)
    objects, total = choose_objects(dataset, protocol, words_of(options.objects)), len(dataset.objects())
    if not options.objects and protocol.subset is not None and len(objects) < total:
        taken = f"{protocol.name} takes {len(objects)} of {total} objects, {SUBSETS[protocol.subset][0]}"
        note(f"{taken}: {', '.join(objects)}; --objects NAME,NAME takes others")
    folder = (options.output or Path("evaluation") / title / protocol.name).resolve()
    settings, cdpam = options.all_settings, protocol.scoring == "sounds" and not options.no_cdpam
    evaluation = plan_evaluation(
        dataset,
        title,
        protocol,
        methods,
        settings=settings,
        views=ViewsConfig(source=options.visual_source),
        cache=(options.cache or folder / "features").resolve(),
        metrics=MetricSettings(cdpam, options.cdpam_contacts),
        seed=options.seed,
        device=options.device,
        time_zero=options.time_zero,
        log=say,
    )
    if options.time_zero == "peak":
        evaluation = replace(evaluation, own_starts=opened())
    _note_start(methods, options.time_zero)
    results = ResultsFolder(folder)
    work = f"{counted(len(objects), 'object')}, {counted(len(methods), 'method')}"
    say(f"{protocol.name} on {title}: {work}, results in {folder}")
    wanted = dict.fromkeys(objects, tuple(method.name for method in methods))
    write = partial(write_summary, results, subsets=members(dataset), wanted=wanted)
    try:
        shown = display.objects(write)
        run_objects(evaluation, objects, results, workers=options.workers, address=options.ray, progress=shown)
    except KeyboardInterrupt:
        if (folder / IDENTITY).exists():
            write()
        raise
    summary, parts = write(), write_page(results)
    text = _words(folder, summary, parts, write_figures(results) if options.figures else [])
    another = f"avmsf evaluate {'farthest' if protocol.name == 'shots' else 'shots'}"
    steps = command("open", folder / PAGE, "in a browser"), command(another, options.data)
    return finish(text, {**summary, "results": str(folder)}, *steps, code=FAILED if summary["failures"] else 0)


def _words(folder: Path, summary: Mapping[str, Any], parts: "Sequence[Section]", figures: Sequence[Path]) -> str:
    """Return the main tables, failures and files. Raises EvaluationError where no method has a result."""
    from avmsf.evaluation.report import PAGE, SUMMARY, TABLES

    failures = summary["failures"]
    if not summary["methods"]:
        got = f"none: {failures[0]['failure'] if failures else 'no object'}"
        raise EvaluationError.expected("a result of a method", len(failures), got=got, file=folder, name="failures")
    # Without standard errors, which are in the reports and would fold a narrow screen's lines.
    lines = [
        table(part.title, part.columns, [[cell.partition(" ±")[0] for cell in row] for row in part.rows])
        for part in parts[1:3]
        if part.columns
    ]
    lines += [f"failed: {each['object']}, {each['method'] or 'all'}: {each['failure']}" for each in failures]
    if failures:
        lines.append(f"{counted(len(failures), 'failure')}; run the command again to retry")
    lines.append(f"wrote {SUMMARY}, {TABLES} and {PAGE} in {folder}")
    return "\n".join([*lines, *(f"wrote {path}" for path in figures)])


def _protocol_of(options: Options) -> "Protocol":
    """Return the protocol with its own options, and print which of those that were given it does not use."""
    protocol, usual = protocol_named(options.protocol), Options(options.protocol, options.data)
    own: dict[str, dict[str, Any]] = {
        "predefined": {"test": words_of(options.test)},
        "shots": {"counts": options.counts, "starts": options.starts},
    }
    for owner, settings in own.items():
        unused = [f"--{name}" for name in settings if getattr(options, name) != getattr(usual, name)]
        if unused and owner != protocol.name:
            note(f"{', '.join(unused)}: not used by {protocol.name}, only by {owner}")
    return replace(protocol, settings=own.get(protocol.name, {}))


def _note_start(methods: "Sequence[Method]", time_zero: TimeZero | None) -> None:
    """Print which methods are configured for, or may have, another start of sounds than the evaluation has."""
    from avmsf.evaluation.methods import FieldMethod, RecordedMethod

    for method in methods:
        if isinstance(method, RecordedMethod) and time_zero == "peak":
            note(
                f"the files of {method.name} are taken as they are; with --time-zero peak each has to start "
                "at its largest sample, as the recordings do"
            )
        wanted = method.pipeline.time_zero if isinstance(method, FieldMethod) else None
        if wanted not in (None, time_zero):
            note(f"{method.name} is published with sounds from their {wanted}s: --time-zero {wanted}")
