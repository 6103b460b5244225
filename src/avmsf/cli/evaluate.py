"""`avmsf evaluate`: the errors of methods on a dataset, as tables and as a page."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from avmsf._utils.text import counted
from avmsf.cli import INTERRUPTED
from avmsf.cli.common import Configured, Flag, expect_device
from avmsf.cli.paths import CacheFolder, Existing, OutputFolder
from avmsf.cli.printing import display, next_command, next_step, note, print_json, say, show, table
from avmsf.cli.settings import with_settings
from avmsf.datasets.detect import detect_dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.config import EvaluationSettings
from avmsf.evaluation.registry import PROTOCOLS, expect_suited, method_entry, protocol_named
from avmsf.pipeline.config import TimeZero, ViewsConfig

if TYPE_CHECKING:
    from avmsf.datasets.dataset import Dataset
    from avmsf.evaluation.registry import Protocol
    from avmsf.evaluation.report_tables import Section
    from avmsf.evaluation.task import Method

OPTIONS = {"predefined": ("test",), "shots": ("counts", "starts")}
"""Options of one protocol alone."""
_SHOWN = 5
"""Failures that are printed; the report lists all."""


@dataclass(frozen=True)
class Options(Configured):
    """Evaluate methods at held-out contacts, on all objects of a dataset.

    Every value is kept as it is computed: repeat an interrupted command to continue it, and add methods or objects
    later. The folder of results holds summary.json, report.md and report.html, which shows and plays sounds.
    """

    protocol: tyro.conf.Positional[
        Annotated[str, tyro.conf.arg(metavar="PROTOCOL", help=f"The experiment: {', '.join(PROTOCOLS)}.")]
    ]
    data: tyro.conf.Positional[
        Annotated[
            Path, tyro.conf.arg(metavar="DATA"), Existing("a dataset, capture folders or one capture", ("a folder",))
        ]
    ]
    """Folder of a dataset, of capture folders, or of one capture."""
    methods: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Methods, separated by commas or blanks; by default those of the protocol."""
    objects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Objects, likewise."""
    output: OutputFolder = None
    """Folder of results, by default evaluation/DATASET/PROTOCOL."""
    cache: CacheFolder = None
    """Folder of the objects' features, which several evaluations may share; by default in the results."""
    test: Annotated[tuple[str, ...], tyro.conf.arg(metavar="RECORDING ...")] = ()
    """predefined: names of the recordings to test on, such as 009.wav, separated by commas or blanks."""
    counts: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (16, 8, 4, 2, 1)
    """shots: numbers of training contacts."""
    starts: int = 1
    """shots: number of first contacts that the choices start from."""
    visual_source: Literal["best", "mesh"] = "best"
    """Features of photographs, if there are any, by Gaussians (best), or always of the mesh."""
    workers: int = 1
    """Objects computed at a time, each on one thread; more than one needs the extra `scale`."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address of a ray cluster, or auto; its computers have to see data and results at the same paths."""
    seed: int = 0
    """Seed of all methods."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device for Gaussians, DINOv2 and training; by default the GPU if there is one."""
    no_cdpam: Flag = False
    """Do not compute the metric CDPAM, which needs the extra `eval`."""
    cdpam_contacts: int = 8
    """Test contacts per case at which CDPAM is computed, evenly spaced; 0 for all."""
    time_zero: TimeZero | None = None
    """Start of the sounds that are scored; with peak (paper) without comparison with ground truth."""
    contact_data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER"), Existing("ObjectFolder Real's contacts", ("a folder",))
    ] = None
    """ObjectFolder Real's contacts: SonicGauss's lists in a folder, or one of them."""
    figures: Flag = False
    """Also draw spectrograms of all methods, and heat maps with localize, to figures/ in the folder of results."""

    usual = EvaluationSettings()

    @cached_property
    def all_settings(self) -> EvaluationSettings:
        """What methods share."""
        return with_settings(self.usual, self.set, self.config)

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        protocol_named(self.protocol)
        for name in words_of(self.methods):
            method_entry(name)
            expect_suited(name, self.protocol)
        if self.protocol == "predefined" and not self.test:
            raise EvaluationError.expected(
                "names of the recordings to test on", name="--test", advice="such as --test 009.wav,010.wav"
            )
        expect_device(self.device, raising=EvaluationError)
        _ = self.all_settings
        detect_dataset(self.data)


def words_of(given: Sequence[str]) -> tuple[str, ...]:
    """Return words that commas or blanks separate."""
    return tuple(word for each in given for word in each.split(",") if word)


def run(options: Options) -> int:
    """Evaluate, and print the results; return 130 where Ctrl-C stopped it."""
    from avmsf.datasets import open_dataset
    from avmsf.evaluation.methods import method_named
    from avmsf.evaluation.objects import choose_objects, members
    from avmsf.evaluation.plan import dataset_title, plan_evaluation
    from avmsf.evaluation.report import PAGE, SUMMARY, TABLES, write_figures, write_page, write_summary
    from avmsf.evaluation.results import IDENTITY, ResultsFolder
    from avmsf.evaluation.runner import run_objects
    from avmsf.evaluation.scores import MetricSettings

    protocol = _protocol_of(options)
    methods = tuple(method_named(name) for name in words_of(options.methods) or protocol.methods)
    # All paths are made absolute: workers may run in folders of their own.
    contacts = None if options.contact_data is None else options.contact_data.resolve()
    opened = partial(open_dataset, options.data.resolve(), contacts=contacts)
    dataset = opened(time_zero=options.time_zero)
    title = dataset_title(dataset, options.data)
    objects = choose_objects(dataset, protocol, words_of(options.objects))
    if not options.objects:
        _note_subset(dataset, protocol, objects)
    folder = (options.output or Path("evaluation") / title / protocol.name).resolve()
    settings, cdpam = options.all_settings, not (options.no_cdpam or protocol.locating)
    evaluation = plan_evaluation(
        dataset,
        title,
        protocol,
        methods,
        settings=settings,
        views=ViewsConfig(source=options.visual_source),
        cache=(options.cache or folder / "features").resolve(),
        metrics=MetricSettings(settings.amplitude_scale, cdpam, options.cdpam_contacts),
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
        summary, parts = write(), write_page(results)
        figures = write_figures(results) if options.figures else []
    except KeyboardInterrupt:
        if (folder / IDENTITY).exists():
            missing = write()["missing"]
            lacking = f", without all results of {counted(len(missing), 'object')}" if missing else ""
            say(f"wrote {SUMMARY} and {TABLES} in {folder}{lacking}")
        say(f"avmsf evaluate: interrupted; run the same command again to continue from {folder}", always=True)
        return INTERRUPTED
    _print_results(options, folder, summary, parts, figures)
    next_step(f"open {shlex.quote(str(folder / PAGE))} in a browser")
    next_command(f"avmsf evaluate {'farthest' if protocol.name == 'shots' else 'shots'}", options.data)
    return 0


def _print_results(
    options: Options, folder: Path, summary: Mapping[str, Any], parts: "Sequence[Section]", figures: Sequence[Path]
) -> None:
    """Print the main tables, failures and files. Raises EvaluationError where no method has a result."""
    from avmsf.evaluation.report import PAGE, SUMMARY, TABLES

    failures = summary["failures"]
    if not summary["methods"]:
        got = f"none: {failures[0]['failure'] if failures else 'no object'}"
        raise EvaluationError.expected("a result of a method", len(failures), got=got, file=folder, name="failures")
    lines = [*_tables(parts[1:3]), *_failures(failures)]
    lines += [f"wrote {SUMMARY}, {TABLES} and {PAGE} in {folder}", *(f"wrote {path}" for path in figures)]
    show("\n".join(lines), json=options.json)
    if options.json:
        print_json({**summary, "results": str(folder)})


def _tables(parts: "Sequence[Section]") -> list[str]:
    """Return tables without standard errors, which are in the reports and would fold a narrow screen's lines."""
    return [
        table(part.title, part.columns, [[cell.partition(" ±")[0] for cell in row] for row in part.rows])
        for part in parts
        if part.columns
    ]


def _failures(failures: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the first failures, and how many there are."""
    lines = [f"failed: {each['object']}, {each['method'] or 'all'}: {each['failure']}" for each in failures[:_SHOWN]]
    count = counted(len(failures), "failure")
    return [*lines, f"{count}, listed in the report; run the command again to retry"] if failures else []


def _protocol_of(options: Options) -> "Protocol":
    """Return the protocol with its own options, and print which of those that were given it does not use."""
    from avmsf.evaluation.splits import Predefined, Shots

    protocol, usual = protocol_named(options.protocol), Options(options.protocol, options.data)
    for owner, names in OPTIONS.items():
        unused = [f"--{name}" for name in names if getattr(options, name) != getattr(usual, name)]
        if unused and owner != protocol.name:
            note(f"{', '.join(unused)}: not used by {protocol.name}, only by {owner}")
    if protocol.name == "shots":
        return replace(protocol, cases=Shots(options.counts, options.starts))
    return replace(protocol, cases=Predefined(words_of(options.test))) if protocol.name == "predefined" else protocol


def _note_subset(dataset: "Dataset", protocol: "Protocol", objects: Sequence[str]) -> None:
    """Print which objects a protocol takes of a dataset, where it does not take all."""
    from avmsf.evaluation.objects import SUBSETS

    total = len(dataset.objects())
    if protocol.subset is not None and len(objects) < total:
        note(
            f"{protocol.name} takes {len(objects)} of {total} objects, {SUBSETS[protocol.subset]}: "
            f"{', '.join(objects)}; --objects NAME,NAME takes others"
        )


def _note_start(methods: "Sequence[Method]", time_zero: TimeZero | None) -> None:
    """Print which methods are configured for, or may have, another start of sounds than the evaluation has."""
    from avmsf.evaluation.field_methods import FieldMethod
    from avmsf.evaluation.recorded import RecordedMethod

    for method in methods:
        if isinstance(method, RecordedMethod) and time_zero == "peak":
            note(
                f"the files of {method.name} are taken as they are; with --time-zero peak each has to start "
                "at its largest sample, as the recordings do"
            )
        wanted = method.pipeline.time_zero if isinstance(method, FieldMethod) else None
        if wanted not in (None, time_zero):
            note(f"{method.name} is published with sounds from their {wanted}s: --time-zero {wanted}")
