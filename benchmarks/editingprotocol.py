"""The paper's protocol of editing: `python -m benchmarks.editingprotocol DATASET`, or with `--simulated` in its place.

On 26 objects of RealImpact, of which those that were not downloaded are left out and named, or on simulated objects of
seven materials. With `--model` and `--clap` towards words, as the paper does it: each object of a transition's first
material with two prompts for the second, by direct generation, Audio-SDS (every mode by itself) and ours, judged by the
CLAP score and the UMAP distance. Without a model towards recordings of another object of the second material, which
needs no weights.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean

from avmsf.datasets import open_dataset
from avmsf.datasets.dataset import Dataset
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.clap import Clap
from avmsf.evaluation.objects import ObjectInputs
from avmsf.fem.material import MATERIALS
from avmsf.pipeline.config import DINO, PRESETS
from avmsf.pipeline.features import choose_encoder
from benchmarks.editing import (
    GENERATED,
    PHYSICS,
    RECORDED_TRANSITIONS,
    EditMethod,
    EditScore,
    EditTask,
    Transition,
    prompted_tasks,
    score_edits,
    towards_reference,
    towards_words,
    write_scores,
)
from benchmarks.editing_objects import (
    PUBLISHED,
    REALIMPACT_26,
    KnownObject,
    paper_object,
    plain_object,
    recorded_objects,
)
from benchmarks.editingfigures import write_figures
from benchmarks.mode_embedding import FEATURES, MaterialSpace
from benchmarks.report import Options, Report, Table, log, show
from benchmarks.simulatedobjects import OTHER_SHAPES, SHAPES, SolvedShape, drawn_size, simulated_objects

SIMULATED_TRANSITIONS: tuple[Transition, ...] = (("ceramic", "wood"), ("glass", "steel"), ("wood", "glass"))
"""Those that are evaluated with recordings as target and several seeds."""
_RING = ("ceramic", "wood", "glass", "steel", "plastic", "iron", "polycarbonate")
SEVEN_TRANSITIONS: tuple[Transition, ...] = tuple(zip(_RING, (*_RING[1:], _RING[0]), strict=True))
"""Every one of the seven simulated materials is left once and reached once, by a neighbor that it contrasts with."""
LEAST = 8
"""Objects that an embedding of materials needs to mean anything."""
PREVIEWS = 20
"""Sounds of each edit of which the CLAP score is taken, about, for its curve over the steps."""
EDITING_UMAP = {"Generation": 3.077, "Audio-SDS": 4.234, "AV-MSF": 2.753}
"""The paper's UMAP distance to the target material after an edit, by what it calls the method."""
SEEDS, STEPS = range(3), 100
"""Of the part `edit`: each seed takes another object, another reference and other chance."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Objects whose modes make the clusters, and what is asked of some."""

    name: str
    """What keys begin with."""
    labelled: tuple[KnownObject, ...]
    tasks: tuple[EditTask, ...]
    what: str
    """The objects, in words."""
    known: bool
    """Whether the constants of the objects' materials are: else the laws of elasticity have nothing to go by."""
    remarks: tuple[str, ...] = ()


def measure_simulated(options: Options) -> Report:
    """Return the figures of the part `edit`: towards recordings, on simulated objects."""
    if options.quick_look:
        return measure(simulated_cast(SIMULATED_TRANSITIONS, SEEDS[:1], kinds=SHAPES[:2]), steps=5)
    return measure(simulated_cast(SIMULATED_TRANSITIONS, SEEDS), steps=STEPS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Edit, judge and print; return 0, or 2 for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.editingprotocol", description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?", help="folder of RealImpact")
    parser.add_argument("--simulated", action="store_true", help="simulated objects in place of a dataset")
    parser.add_argument("--model", help="Stable Audio: a name on the hub or a folder; without it, towards recordings")
    parser.add_argument("--model-seconds", type=float, help="that the model works at in a descent; all it has without")
    parser.add_argument("--generated", type=float, default=GENERATED, help="seconds of a directly generated sound")
    parser.add_argument("--clap", help="CLAP: a name on the hub or a folder; without it, no CLAP score")
    parser.add_argument("--steps", type=int, default=None, help="of each descent; by itself what `avmsf edit` takes")
    preset = "paper: modes of section 3.4, fields trained as published, its parameters of an edit"
    parser.add_argument("--preset", choices=("default", "paper"), default="default", help=preset)
    parser.add_argument("--encoder", default=DINO, help="of --preset paper: DINOv2's name or folder, or descriptors")
    parser.add_argument("--cache", type=Path, help="folder that keeps Gaussians and features of --preset paper")
    parser.add_argument("--seed", type=int, default=0, help="of all chance")
    parser.add_argument("--record", type=Path, help="JSON file for all scores and the embeddings they rest on")
    parser.add_argument("--figures", type=Path, help="folder for UMAP and CLAP figures, as editingfigures draws them")
    chosen = parser.parse_args(arguments)
    if (chosen.dataset is not None) == chosen.simulated:
        parser.error("expected the folder of a dataset or --simulated, one of the two")
    if chosen.model is None and (chosen.clap, chosen.model_seconds, chosen.generated) != (None, None, GENERATED):
        parser.error("--clap, --model-seconds and --generated go with --model, which is not given")
    paper = chosen.preset == "paper"
    if paper and (chosen.simulated or chosen.cache is None):
        parser.error("--preset paper goes with the folder of a dataset and with --cache")
    if chosen.figures is not None and chosen.record is None:
        parser.error("--figures goes with --record, which is not given")
    try:
        # The models first: where one cannot be loaded nothing else is worth its time.
        model = None if chosen.model is None else StableAudio.load(chosen.model, seconds=chosen.model_seconds)
        clap = None if chosen.clap is None else Clap.load(chosen.clap)
        words = model is not None
        cast = (
            simulated_cast(SEVEN_TRANSITIONS, range(chosen.seed, chosen.seed + 2), words=words)
            if chosen.simulated
            else recorded_cast(
                chosen.dataset, words=words, seed=chosen.seed, paper=(chosen.encoder, chosen.cache) if paper else None
            )
        )
        report = measure(
            cast,
            model=model,
            clap=clap,
            steps=chosen.steps,
            generated=chosen.generated,
            seed=chosen.seed,
            record=chosen.record,
            paper=paper,
        )
        if chosen.figures is not None:
            write_figures(chosen.record, chosen.figures)
    except AvmsfError as error:
        print(f"benchmarks.editingprotocol: {error}", file=sys.stderr)
        return 2
    show(report, Options((cast.name, "words" if words else "recordings")), name="editingprotocol")
    return 0


def recorded_cast(folder: Path, *, words: bool, seed: int = 0, paper: tuple[str, Path] | None = None) -> Cast:
    """Return the objects of RealImpact that are there; `paper` names an encoder and a folder for what it makes.

    With `paper` recordings start at their peaks, as in that preset. Raises AvmsfError where the dataset cannot be read
    or holds too few.
    """
    dataset = open_dataset(folder, time_zero=None if paper is None else PRESETS["paper"].time_zero)
    missing = sorted(set(REALIMPACT_26) - set(dataset.objects()))
    if len(REALIMPACT_26) - len(missing) < LEAST:
        raise EvaluationError(
            f"{folder}: expected {LEAST} objects of known materials or more, got {len(REALIMPACT_26) - len(missing)}; "
            f"download more, such as {', '.join(missing[:3])}",
            file=folder,
            name=dataset.name,
            value=len(REALIMPACT_26) - len(missing),
        )
    log(f"editing: extracting modes of {len(REALIMPACT_26) - len(missing)} objects")
    objects = recorded_objects(
        dataset, make=plain_object if paper is None else _paper_maker(dataset, *paper, seed=seed)
    )
    present = {each.material for each in objects}
    transitions = [each for each in RECORDED_TRANSITIONS if {*each} <= present]
    tasks = prompted_tasks(objects, transitions, seed=seed) if words else tuple(_referred_tasks(objects, seed=seed))
    if not tasks:
        pairs = ", ".join(map(" to ".join, RECORDED_TRANSITIONS))
        raise EvaluationError(
            f"{folder}: expected objects of a material to edit, {pairs}, found {', '.join(sorted(present))}",
            file=folder,
            value=tuple(sorted(present)),
        )
    fields = "fields by kernels of positions" if paper is None else f"modes and fields of the paper, encoder {paper[0]}"
    what = (
        f"{len(objects)} objects of RealImpact, the nearest microphone, modes extracted from all recordings, {fields} "
    )
    what += "(which 26 objects and which prompts the paper took is not said there, so that these are ours)"
    left_out = f"missing and left out: {', '.join(missing) or 'none'}."
    return Cast("realimpact", objects, tasks, what, known=False, remarks=(left_out,))


def _paper_maker(dataset: Dataset, encoder: str, cache: Path, *, seed: int) -> Callable[..., KnownObject]:
    scene = PRESETS["paper"].scene
    lift = replace(scene.lift, encoder=encoder, seed=seed)
    # Before the modes of all objects: without the encoder nothing else is worth its time.
    choose_encoder(lift, log=log)
    scene = replace(scene, splat=replace(scene.splat, seed=seed), lift=lift)
    inputs, config = ObjectInputs(dataset, cache, scene, lift), replace(PUBLISHED, seed=seed)
    features = partial(inputs.features, visual_input="paper")
    return partial(paper_object, features=features, config=config, checkpoints=cache / "training")


def simulated_cast(
    transitions: Sequence[Transition], seeds: Iterable[int], *, words: bool = False, kinds: Sequence[str] = SHAPES
) -> Cast:
    """Return the simulated objects: shapes in seven materials make the clusters, two others are edited.

    Towards recordings each seed edits one of the two, and the other one is the reference.
    """
    log("editing: solving shapes")
    labelled = simulated_objects(SolvedShape.of(kind, seed=11) for kind in kinds)
    shapes = [SolvedShape.of(kind, seed=12) for kind in OTHER_SHAPES]

    def one(shape: SolvedShape, material: str, seed: int) -> KnownObject:
        size = drawn_size(shape.kind, material, seed=100 + seed)
        return shape.struck(MATERIALS[material], size=size)

    tasks: list[EditTask] = []
    for source, target in transitions:
        for seed in seeds:
            edited = one(shapes[seed % 2], source, seed)
            if words:
                tasks += prompted_tasks([edited], [(source, target)], seed=seed)
            else:
                reference = _reference_of(one(shapes[1 - seed % 2], target, seed))
                tasks.append(EditTask(edited, target, reference=reference, seed=seed))
    what = (
        f"simulated objects: {', '.join(kinds)} in seven materials, each in a size of its own, .7 to 1.4 times, make "
        f"the clusters; {' and '.join(OTHER_SHAPES)}, which are in no cluster, are edited. Modes are the finite "
        "elements' own, Poisson's ratio .27 throughout; those within 60 dB of the loudest are compared"
    )
    return Cast("simulated", labelled, tuple(tasks), what, known=True)


def measure(
    cast: Cast,
    *,
    model: StableAudio | None = None,
    clap: Clap | None = None,
    steps: int | None = None,
    generated: float = GENERATED,
    seed: int = 0,
    record: Path | None = None,
    paper: bool = False,
) -> Report:
    """Return the table of all methods, mean over edits and by transition.

    Towards the tasks' prompts by a model, else towards their references. Raises AvmsfError as the methods do.
    """
    banks, materials = ([getattr(each, name) for each in cast.labelled] for name in ("bank", "material"))
    names = [each.name for each in cast.labelled]
    spaces = {each: MaterialSpace.of(banks, materials, names=names, features=each, seed=seed) for each in FEATURES}
    settings = {} if steps is None else {"steps": steps}
    if clap is not None:
        settings["preview_every"] = max(1, (steps or GuidedEditConfig().steps) // PREVIEWS)
    methods: tuple[EditMethod, ...]
    if model is not None:
        methods = towards_words(model, settings, generated=generated, paper=paper)
    else:
        methods = tuple(each for each in towards_reference(settings, paper=paper) if cast.known or each is not PHYSICS)
    scores = score_edits(cast.tasks, methods, spaces, clap=clap, progress=_tell_score)
    if record is not None:
        write_scores(scores, spaces, record)
    told_apart = {f"{cast.name}.told_apart_{name}": each.nearest_neighbor_accuracy() for name, each in spaces.items()}
    return _report(scores, cast, methods, words=model is not None) + Report(figures=told_apart)


def _referred_tasks(objects: Sequence[KnownObject], *, seed: int) -> Iterator[EditTask]:
    """Return every object of a transition's source, towards recordings of one object of its target.

    The objects of the target take turns, in their order.
    """
    for source, target in RECORDED_TRANSITIONS:
        targets = [each for each in objects if each.material == target]
        sources = [each for each in objects if each.material == source]
        for number, each in enumerate(sources if targets else []):
            yield EditTask(each, target, reference=_reference_of(targets[number % len(targets)]), seed=seed)


def _reference_of(known: KnownObject) -> Reference:
    return Reference.of(known.impacts.sounds, sample_rate=known.impacts.sample_rate, name=known.name)


def _report(scores: Sequence[EditScore], cast: Cast, methods: Sequence[EditMethod], *, words: bool) -> Report:
    """Return the means over all edits and over those of each transition."""
    pairs = list(dict.fromkeys((task.object.material, task.target) for task in cast.tasks))
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for method in methods:
        for pair in (None, *pairs):
            own = [each for each in scores if each.method == method.name and pair in (None, (each.source, each.target))]
            values = {
                "umap": _mean([each.umap["pitches"] for each in own]),
                "umap_rings": _mean([each.umap["rings"] for each in own]),
                "clap": _mean([each.clap for each in own if each.clap is not None]),
                "spectral": _mean([each.spectral for each in own if each.spectral is not None]),
                "seconds": _mean([each.seconds for each in own]),
            }
            rows.append([f"{method.name}, {'all' if pair is None else ' to '.join(pair)}", len(own), *values.values()])
            if pair is None:
                figures |= {f"{cast.name}.{name}_{method.name}": value for name, value in values.items()}
    conventions = (
        f"{cast.what}; led towards {'two prompts' if words else 'recordings of an object'} of the target material; "
        f"seeds {', '.join(map(str, sorted({task.seed for task in cast.tasks})))}. umap: distance to the center of the "
        "target's cluster by frequencies, as in the paper; umap_rings: with dampings; clap: mean cosine of sounds and "
        "prompt; spectral: relative STFT error from the nearest clip of the reference, at equal level. edits: those "
        "with a score; a generated sound may hold no mode. told_apart: part of the labelled objects whose nearest "
        "other is of the same material. physics: both materials' constants known, so neither baseline nor rival.",
        *cast.remarks,
        f"umap in the paper: {', '.join(f'{title} {value:g}' for title, value in EDITING_UMAP.items())}; its choice of "
        "objects and prompts is not published, and every set of objects has another UMAP.",
    )
    columns = ("method", "edits", "umap", "umap_rings", "clap", "spectral", "seconds")
    title = f"editing, {cast.name}: means over {len(cast.tasks)} edits"
    return Report(conventions, (Table(title, columns, rows),), figures)


def _mean(values: Sequence[float]) -> float:
    """Return the mean, not a number of nothing."""
    return mean(values) if values else float("nan")


def _tell_score(score: EditScore) -> None:
    log(f"editing: {score.object} to {score.target}, {score.method}: umap {score.umap['pitches']:.2f}")


if __name__ == "__main__":
    sys.exit(main())
