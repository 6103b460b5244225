"""`avmsf evaluate`: how good methods are on a dataset, as tables and as a page."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from avmsf.bench.judging import Judging
from avmsf.bench.methods import method_named
from avmsf.bench.parallel import RunProgress, Workers, run_objects
from avmsf.bench.plan import Evaluation
from avmsf.bench.protocols import EvaluationProtocol, protocol_named
from avmsf.bench.report import PAGE, SUMMARY, TABLES, write_figures, write_page, write_summary
from avmsf.bench.reporttables import Section
from avmsf.bench.results import ResultsFolder
from avmsf.bench.subsets import choose_objects, members
from avmsf.bench.task import Method
from avmsf.capture.datasets import CaptureCollection, open_dataset
from avmsf.capture.datasets.dataset import Dataset
from avmsf.cli import INTERRUPTED
from avmsf.cli.objectbar import ObjectBar
from avmsf.cli.printing import console, print_json, say, table
from avmsf.errors import EvaluationError
from avmsf.modal.extraction.finders import HighResolution
from avmsf.pipeline.config import AUTO, PRESETS, BodyConfig, Geometry, LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.features import choose_encoder, settled
from avmsf.pipeline.objectbodies import ObjectBodies
from avmsf.pipeline.objectlooks import ObjectLooks
from avmsf.scene.splatconfig import SplatConfig

_SHOWN = 5
"""Failures that are printed; the report lists all."""


@dataclass(frozen=True)
class Options:
    """Judge methods by contacts that they were not trained on, on all objects of a dataset.

    Every figure is kept as it comes: after an interruption the same command goes on, and methods or objects may be
    added later. The folder of results holds summary.json, report.md and report.html, which shows and plays sounds.
    """

    protocol: tyro.conf.Positional[str]
    """The experiment: farthest, leave-one-out, closest, shots, views, ablation, non-symmetric or grid."""
    data: tyro.conf.Positional[Path]
    """Folder of a dataset, of capture folders, or of one capture."""
    methods: tuple[str, ...] = ()
    """Methods, apart from each other by commas or blanks; the protocol's own where none is named."""
    objects: tuple[str, ...] = ()
    """Objects, likewise; the protocol's own where none is named."""
    output: Path | None = None
    """Folder of results; evaluation/DATASET/PROTOCOL in the current folder where it is not given."""
    features: Path | None = None
    """Folder that keeps what objects look like, which several evaluations of one dataset may share; features in the
    folder of results where it is not given."""
    look: Literal["best", "mesh"] = "best"
    """What looks are lifted from: the best of what shows an object, photographs before a mesh, which takes Gaussians;
    or its mesh, onto whose own surface they go."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    """Settings of the features. The methods `paper` have the paper's own, of which they take the encoder alone from
    here: DINOv2 without `--lift.encoder`, which then must be there."""
    workers: int = 1
    """Objects at a time, each on one thread; more than one needs the extra `scale`."""
    ray: str | None = None
    """Address of a ray cluster to compute on, or auto; its computers must see data and results under the same paths."""
    seed: int = 0
    """Start of all chance in the methods."""
    geometry: Geometry = "mesh"
    """What physics knows of an object's shape: its mesh; the surface of Gaussians fitted to its views; noisy, its mesh
    with vertices displaced by 2 % of its size."""
    body: BodyConfig = field(default_factory=BodyConfig)
    level: Literal["full-scale", "raw"] = "full-scale"
    """full-scale: an object's sounds by one factor that brings its loudest recording to a peak of one, so that figures
    of different objects can be averaged; raw: in the recordings' unit."""
    cdpam: bool = True
    """Whether CDPAM is taken, which needs the extra `eval`."""
    cdpam_contacts: int = 8
    """Test contacts of a case that CDPAM is taken of, spread evenly; 0 for all."""
    modes: int = 128
    """Most modes that are sought in the training recordings."""
    contacts: Path | None = None
    """Where ObjectFolder Real's contacts are, for its raw form."""
    table: Path | None = None
    """The published table of ObjectFolder Real's names and materials."""
    figures: bool = False
    """Also draw figures/OBJECT.png: spectrograms of the recording and of all methods, 20 Hz to 20 kHz, first second."""
    json: bool = False
    """Print the summary as one JSON object on the standard output, all else on the standard error."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf evaluate", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Evaluate, and say what came of it; return 130 where Ctrl-C stopped it."""
    protocol = protocol_named(options.protocol)
    methods = tuple(method_named(name) for name in _words(options.methods) or protocol.methods)
    workers = Workers(options.workers, options.ray)
    # All paths are made absolute: workers may run in folders of their own.
    contacts, table_of_names = (None if path is None else path.resolve() for path in (options.contacts, options.table))
    dataset = open_dataset(options.data.resolve(), contacts=contacts, table=table_of_names)
    title = title_of(dataset, options.data)
    objects = choose_objects(dataset, protocol, _words(options.objects))
    folder = (options.output or Path("evaluation") / title / protocol.name).resolve()
    evaluation = evaluation_of(
        dataset,
        title,
        protocol,
        methods,
        (options.features or folder / "features").resolve(),
        scene=SceneConfig(ViewsConfig(source=options.look), options.splat, options.lift),
        geometry=options.geometry,
        body=options.body,
        judging=Judging(level=options.level, cdpam=options.cdpam, cdpam_contacts=options.cdpam_contacts),
        modes=options.modes,
        seed=options.seed,
    )
    results, groups = ResultsFolder(folder), members(dataset)
    say(f"{protocol.name} on {title}: {len(objects)} objects, {len(methods)} methods, results in {folder}")
    try:
        run_shown(evaluation, objects, results, workers, after_each=partial(write_summary, results, subsets=groups))
        summary = write_summary(results, subsets=groups)
        parts = write_page(results, subsets=groups)
        figures = write_figures(results) if options.figures else []
    except KeyboardInterrupt:
        say(f"avmsf evaluate: interrupted; the same command goes on from what {folder} holds")
        return INTERRUPTED
    if not summary["methods"]:
        first = summary["failures"][0]["failure"] if summary["failures"] else "there is no object"
        raise EvaluationError(f"no method has a figure: {first}")
    screen = console(errors=options.json)
    for part in parts[1:3]:
        _print(part, screen)
    failures = len(summary["failures"])
    if failures:
        for each in summary["failures"][:_SHOWN]:
            screen.print(f"failed: {each['object']}, {each['method'] or 'all'}: {each['failure']}", soft_wrap=True)
        screen.print(f"failures: {failures}, listed in {TABLES}; asked for again, they are tried again", soft_wrap=True)
    screen.print(f"wrote {SUMMARY}, {TABLES} and {PAGE} in {folder}", soft_wrap=True)
    for path in figures:
        screen.print(f"wrote {path}", soft_wrap=True)
    if options.json:
        print_json({**summary, "results": str(folder)})
    return 0


def evaluation_of(
    dataset: Dataset,
    title: str,
    protocol: EvaluationProtocol,
    methods: tuple[Method, ...],
    kept: Path,
    *,
    scene: SceneConfig,
    judging: Judging,
    modes: int,
    seed: int,
    body: BodyConfig,
    geometry: Geometry = "mesh",
) -> Evaluation:
    """Return the plan of an evaluation that keeps features and surfaces in the folder `kept`."""
    lift, paper = settled_lifts(scene.lift, methods)
    scene = replace(scene, lift=lift)
    settings = {"scene": asdict(scene), "paper": asdict(paper), "geometry": geometry, "body": asdict(body)}
    looks, bodies = ObjectLooks(dataset, kept, scene, paper), ObjectBodies(dataset, kept, geometry, body, scene)
    finder = HighResolution(modes=modes)
    return Evaluation(dataset, title, protocol, methods, looks, bodies, seed, judging, finder, settings, looks.cloud)


def run_shown(
    evaluation: Evaluation,
    objects: Sequence[str],
    results: ResultsFolder,
    workers: Workers,
    *,
    after_each: Callable[[], object] = lambda: None,
) -> None:
    """Run an evaluation under a progress bar, and call `after_each` after each object."""
    with ObjectBar() as bar:

        def show(progress: RunProgress) -> None:
            if progress.done > bar.done:
                after_each()
            bar.show(progress.words, done=progress.done, total=progress.total)

        run_objects(evaluation, objects, results, workers=workers, progress=show)


def settled_lifts(lift: LiftConfig, methods: Sequence[Method]) -> tuple[LiftConfig, LiftConfig]:
    """Return how features are made, and how in the paper's form, with the encoders that will be taken.

    What replaces DINOv2 is said, and is part of what results are stored under. Raises SceneError where a method needs
    the paper's encoder and it is not to be had.
    """
    paper = PRESETS["paper"].scene.lift
    if lift.encoder != AUTO:
        return lift, replace(paper, encoder=lift.encoder)
    if any(getattr(method, "look", "").startswith("paper") for method in methods):
        choose_encoder(paper, tell=say)
    return settled(lift, tell=say), paper


def title_of(dataset: Dataset, folder: Path) -> str:
    """Return what reports call a dataset: captures by their folder, which tells them from other captures."""
    return folder.resolve().name if isinstance(dataset, CaptureCollection) else dataset.name


def _words(given: Sequence[str]) -> tuple[str, ...]:
    return tuple(word for each in given for word in each.split(",") if word)


def _print(part: Section, screen: Console) -> None:
    if part.grid is not None:
        # Standard errors, which are in the reports, would fold every cell of a narrow screen.
        rows = [[cell.partition(" ±")[0] for cell in row] for row in part.grid.rows]
        screen.print(table(part.title, part.grid.columns, rows))
