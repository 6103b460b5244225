"""`avmsf evaluate`: the errors of methods on a dataset, as tables and as a page."""

import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf._utils.text import counted
from avmsf.cli import INTERRUPTED
from avmsf.cli.options.evaluate import Options, words_of
from avmsf.cli.printing import console, next_command, next_step, print_json, say, table
from avmsf.cli.progress import ProgressBar
from avmsf.datasets import CaptureCollection, open_dataset
from avmsf.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.case_run import Evaluation
from avmsf.evaluation.field_methods import FieldMethod
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.objects import SUBSETS, ObjectInputs, choose_objects, members
from avmsf.evaluation.published import PUBLISHED
from avmsf.evaluation.recorded import RecordedMethod
from avmsf.evaluation.registry import Protocol, protocol_named
from avmsf.evaluation.report import PAGE, SUMMARY, TABLES, write_figures, write_page, write_summary
from avmsf.evaluation.report_tables import Section
from avmsf.evaluation.results import IDENTITY, ResultsFolder
from avmsf.evaluation.runner import run_objects
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.splits import Predefined, Shots
from avmsf.evaluation.task import Method, VisualInput
from avmsf.modal.extraction.finders import finder_named
from avmsf.pipeline.config import AUTO, PRESETS, LiftConfig, SceneConfig, TimeZero, ViewsConfig
from avmsf.pipeline.features import choose_encoder, settled

OPTIONS = {"predefined": ("test",), "shots": ("counts", "starts")}
"""Options of one protocol alone."""
_SHOWN = 5
"""Failures that are printed; the report lists all."""


def run(options: Options) -> int:
    """Evaluate, and print the results; return 130 where Ctrl-C stopped it."""
    protocol = _protocol_of(options)
    methods = tuple(method_named(name) for name in words_of(options.methods) or protocol.methods)
    # All paths are made absolute: workers may run in folders of their own.
    contacts = None if options.contact_data is None else options.contact_data.resolve()
    opened = partial(open_dataset, options.data.resolve(), contacts=contacts)
    dataset = opened(time_zero=options.time_zero)
    title = title_of(dataset, options.data)
    objects = choose_objects(dataset, protocol, words_of(options.objects))
    if not options.objects:
        _note_subset(dataset, protocol, objects)
    folder = (options.output or Path("evaluation") / title / protocol.name).resolve()
    evaluation = evaluation_of(options, dataset, title, protocol, methods, folder)
    if options.time_zero == "peak":
        evaluation = replace(evaluation, own_starts=opened())
    _note_start(methods, options.time_zero)
    results, groups = ResultsFolder(folder), members(dataset)
    work = f"{counted(len(objects), 'object')}, {counted(len(methods), 'method')}"
    say(f"{protocol.name} on {title}: {work}, results in {folder}")
    names = tuple(method.name for method in methods)
    write = partial(write_summary, results, subsets=groups, wanted=dict.fromkeys(objects, names))
    try:
        run_shown(evaluation, objects, results, options.workers, options.ray, after_each=write)
        summary = write()
        parts = write_page(results)
        figures = write_figures(results) if options.figures else []
    except KeyboardInterrupt:
        if (folder / IDENTITY).exists():
            missing = write()["missing"]
            lacking = f", without all results of {counted(len(missing), 'object')}" if missing else ""
            say(f"wrote {SUMMARY} and {TABLES} in {folder}{lacking}")
        say(f"avmsf evaluate: interrupted; run the same command again to continue from {folder}")
        return INTERRUPTED
    if not summary["methods"]:
        first = summary["failures"][0]["failure"] if summary["failures"] else "no object"
        count = len(summary["failures"])
        raise EvaluationError.expected(
            "a result of a method", count, got=f"none: {first}", file=folder, name="failures"
        )
    screen = console(errors=options.json)
    for part in parts[1:3]:
        _print(part, screen)
    _print_failures(summary["failures"], screen)
    screen.print(f"wrote {SUMMARY}, {TABLES} and {PAGE} in {folder}", soft_wrap=True)
    for path in figures:
        screen.print(f"wrote {path}", soft_wrap=True)
    if options.json:
        print_json({**summary, "results": str(folder)})
    next_step(f"open {shlex.quote(str(folder / PAGE))} in a browser")
    next_command(f"avmsf evaluate {'farthest' if protocol.name == 'shots' else 'shots'}", options.data)
    return 0


def _protocol_of(options: Options) -> Protocol:
    """Return the protocol with its own options, and print which of those that were given it does not use."""
    protocol, usual = protocol_named(options.protocol), Options(options.protocol, options.data)
    for owner, names in OPTIONS.items():
        unused = [f"--{name}" for name in names if getattr(options, name) != getattr(usual, name)]
        if unused and owner != protocol.name:
            say(f"note: {', '.join(unused)}: not used by {protocol.name}, only by {owner}")
    if protocol.name == "shots":
        return replace(protocol, cases=Shots(options.counts, options.starts))
    return replace(protocol, cases=Predefined(words_of(options.test))) if protocol.name == "predefined" else protocol


def _print_failures(failures: Sequence[Mapping[str, Any]], screen: Console) -> None:
    """Print the first failures, and how many there are."""
    for each in failures[:_SHOWN]:
        screen.print(f"failed: {each['object']}, {each['method'] or 'all'}: {each['failure']}", soft_wrap=True)
    if failures:
        failed = counted(len(failures), "failure")
        screen.print(f"{failed}, listed in {TABLES}; run the command again to retry", soft_wrap=True)


def evaluation_of(
    options: Options,
    dataset: Dataset,
    title: str,
    protocol: Protocol,
    methods: tuple[Method, ...],
    folder: Path,
) -> Evaluation:
    """Return the plan of an evaluation with results in a folder, and features in it unless the options name another.

    Raises SceneError for an encoder, and EvaluationError for a device, that is not available.
    """
    device, shared = options.device, options.all_settings
    if device is not None:
        usable_device(device, raising=EvaluationError, kinds=TRAINABLE)
    kept = (options.cache or folder / "features").resolve()
    lift, paper = settled_lifts(shared.lift, inputs_of(methods, protocol), device=device)
    given = SceneConfig(ViewsConfig(source=options.visual_source), shared.splat, shared.lift)
    inputs = ObjectInputs(
        dataset, kept, replace(given, lift=lift), paper, shared.geometry, shared.body, device, seed=options.seed
    )
    cdpam = not options.no_cdpam and not protocol.locating
    return Evaluation(
        dataset,
        title,
        protocol,
        methods,
        inputs,
        options.seed,
        MetricSettings(level=shared.amplitude_scale, cdpam=cdpam, cdpam_contacts=options.cdpam_contacts),
        finder_named(shared.extraction, shared.modes),
        {"scene": asdict(given), "paper": asdict(paper), "geometry": shared.geometry, "body": asdict(shared.body)},
        device,
        None if lift == shared.lift else lift.encoder,
        options.time_zero,
    )


def _note_subset(dataset: Dataset, protocol: Protocol, objects: Sequence[str]) -> None:
    """Print which objects a protocol takes of a dataset, where it does not take all."""
    total = len(dataset.objects())
    if protocol.subset is not None and len(objects) < total:
        say(
            f"note: {protocol.name} takes {len(objects)} of {total} objects, {SUBSETS[protocol.subset]}: "
            f"{', '.join(objects)}; --objects NAME,NAME takes others"
        )


def _note_start(methods: Sequence[Method], time_zero: TimeZero | None) -> None:
    """Print which methods are configured for, or may have, another start of sounds than the evaluation has."""
    for method in methods:
        if isinstance(method, RecordedMethod) and time_zero == "peak":
            say(
                f"note: the files of {method.name} are taken as they are; with --time-zero peak each has to start "
                "at its largest sample, as the recordings do"
            )
        wanted = method.pipeline.time_zero if isinstance(method, FieldMethod) else None
        if wanted not in (None, time_zero):
            say(f"note: {method.name} is published with sounds from their {wanted}s: --time-zero {wanted}")


def run_shown(
    evaluation: Evaluation,
    objects: Sequence[str],
    results: ResultsFolder,
    workers: int,
    address: str | None,
    *,
    after_each: Callable[[], object] = lambda: None,
) -> None:
    """Run an evaluation under a progress bar, and call `after_each` after each object."""
    with ProgressBar() as bar:

        def show(message: str, done: int, total: int) -> None:
            if done > bar.done:
                after_each()
            bar.objects(message, done, total)

        run_objects(evaluation, objects, results, workers=workers, address=address, progress=show)


def settled_lifts(
    lift: LiftConfig, inputs: Collection[VisualInput], *, device: str | None = None
) -> tuple[LiftConfig, LiftConfig]:
    """Return the settings of features, and those of the paper's form, with the encoders that `inputs` are made with.

    Where no method reads views no encoder is loaded. The replacement of DINOv2 is printed. Raises SceneError where one
    reads the paper's features and their encoder is not available.
    """
    paper = PRESETS["paper"].scene.lift
    if lift.encoder != AUTO:
        return lift, replace(paper, encoder=lift.encoder)
    if any(visual_input.startswith("paper") for visual_input in inputs):
        choose_encoder(paper, log=say, device=device)
        return replace(lift, encoder=paper.encoder), paper
    return settled(lift, log=say, device=device) if set(inputs) - {"surface"} else lift, paper


def inputs_of(methods: Sequence[Method], protocol: Protocol) -> frozenset[VisualInput]:
    """Return the features that an evaluation reads: those of its methods, and the points that locate recordings."""
    read = {method.visual_input for method in methods if isinstance(method, FieldMethod)}
    return frozenset(read | {"surface"} if protocol.locating else read)


def title_of(dataset: Dataset, folder: Path) -> str:
    """Return a dataset's name in reports: captures by their folder, which identifies them."""
    if not isinstance(dataset, CaptureCollection):
        return dataset.name
    name = folder.resolve().name
    return f"{name} (captures)" if name in {dataset for dataset, _ in PUBLISHED} else name


def _print(part: Section, screen: Console) -> None:
    if part.columns:
        # Standard errors, which are in the reports, would fold every cell of a narrow screen.
        rows = [[cell.partition(" ±")[0] for cell in row] for row in part.rows]
        screen.print(table(part.title, part.columns, rows))
