"""`avmsf efficiency`: how many places each method needs, as a picture and as figures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from avmsf.bench.efficiency import METHODS, curves, draw_efficiency, efficiency_protocol
from avmsf.bench.judging import Judging
from avmsf.bench.methods import method_named
from avmsf.bench.parallel import Workers
from avmsf.bench.pictures import save_picture
from avmsf.bench.results import ObjectRecord, ResultsFolder, write_json
from avmsf.capture.datasets import open_dataset
from avmsf.cli import INTERRUPTED
from avmsf.cli.evaluate import evaluation_of, run_shown, title_of
from avmsf.cli.printing import console, decimals, print_json, say, table
from avmsf.errors import EvaluationError
from avmsf.pipeline.config import BodyConfig, SceneConfig
from avmsf.wording import counted

PICTURE, FIGURES = "efficiency.png", "efficiency.json"
"""What is written for each object beside the results' own files."""


@dataclass(frozen=True)
class Options:
    """Show how the error falls with the number of places learnt from, for several methods.

    Training places are spread as far apart as they go, from several first ones; the same others judge all methods
    and numbers. Every figure is kept as it comes: after an interruption the same command goes on, and methods may be
    added later.
    """

    data: tyro.conf.Positional[Path]
    """A capture folder with enough places, or a folder of such or a dataset with --object."""
    object: str | None = None
    """Which object of a dataset; not needed where there is only one."""
    methods: tuple[str, ...] = METHODS
    """Methods, apart from each other by commas or blanks, by the names that `avmsf evaluate` knows."""
    counts: tuple[int, ...] = ()
    """Numbers of places to learn from, with all recordings there; 3, 4, 6, 8, 12, 16, ... as far as a quarter is left
    to judge by."""
    starts: int = 3
    """First places, spread evenly over the table."""
    metric: Literal["relative_stft", "l1", "l1_log", "envelope"] = "relative_stft"
    """What is drawn."""
    body: BodyConfig = field(default_factory=BodyConfig)
    output: Path | None = None
    """Folder of results; evaluation/DATA/efficiency in the current folder where it is not given."""
    seed: int = 0
    """Start of all chance in the methods."""
    modes: int = 128
    """Most modes that are sought in the training recordings."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf efficiency", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Evaluate, draw, and say what came of it; return 130 where Ctrl-C stopped it."""
    names = tuple(word for each in options.methods for word in each.split(",") if word)
    methods = tuple(method_named(name) for name in names)
    protocol = efficiency_protocol(options.counts, starts=options.starts, methods=names)
    dataset = open_dataset(options.data.resolve())
    objects = dataset.objects()
    if options.object is None and len(objects) != 1:
        raise EvaluationError(f"{options.data}: holds {len(objects)} objects; name one with --object")
    chosen = objects[0] if options.object is None else dataset.facts(options.object).identifier
    title = title_of(dataset, options.data)
    folder = (options.output or Path("evaluation") / title / protocol.name).resolve()
    evaluation = evaluation_of(
        dataset,
        title,
        protocol,
        methods,
        folder / "features",
        scene=SceneConfig(),
        body=options.body,
        judging=Judging(cdpam=False),
        modes=options.modes,
        seed=options.seed,
    )
    results = ResultsFolder(folder)
    say(f"{protocol.name} of {len(methods)} methods on {chosen}, results in {folder}")
    try:
        run_shown(evaluation, [chosen], results, Workers())
    except KeyboardInterrupt:
        say(f"avmsf efficiency: interrupted; the same command goes on from what {folder} holds")
        return INTERRUPTED
    record = results.read(chosen)
    assert record is not None
    values = _report(record, options, folder / chosen)
    if options.json:
        print_json({**values, "results": str(folder)})
    return 0


def _report(record: ObjectRecord, options: Options, folder: Path) -> dict[str, Any]:
    """Write and print an object's curves; return their figures."""
    found = curves(record, metric=options.metric)
    picture, figures = (folder / name for name in (PICTURE, FIGURES))
    starts = "one choice" if options.starts == 1 else f"{options.starts} choices"
    contacts = f"{counted(record.contacts, 'place')}, {starts} of those learnt from"
    save_picture(draw_efficiency(found, metric=options.metric, title=f"{record.identifier}: {contacts}"), picture)
    failures = {f"{each.method}, {each.case}": each.failure for each in record.outcomes if each.failure is not None}
    values = {
        "object": record.identifier,
        "metric": options.metric,
        "methods": {curve.method: curve.values() for curve in found},
        "failures": failures,
    }
    write_json(figures, values)
    screen = console(errors=options.json)
    counts = sorted({count for curve in found for count in curve.counts})
    rows = []
    for curve in found:
        by_count = dict(zip(curve.counts, curve.mean, strict=True))
        rows.append([curve.method, *(decimals(by_count.get(count), 3) for count in counts)])
    heading = f"{options.metric} of {record.identifier} by the number of places learnt from; {contacts}"
    screen.print(table(heading, ("method", *map(str, counts)), rows))
    for where, why in failures.items():
        screen.print(f"failed: {where}: {why}", soft_wrap=True)
    screen.print(f"wrote {picture} and {figures}", soft_wrap=True)
    return values
