"""Whether an edit towards recordings of another material gets there: ours against one that moves every mode by itself.

Simulated objects: three transitions, three seeds, each with another object, another reference and other chance.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import mean

from avmsf.editing.reference import Reference
from avmsf.evaluation.editing import (
    SIMULATED_TRANSITIONS,
    EditScore,
    EditTask,
    Transition,
    judge,
    towards_reference,
    write_scores,
)
from avmsf.evaluation.editing_objects import (
    OTHER_SHAPES,
    SHAPES,
    KnownObject,
    SolvedShape,
    drawn_size,
    simulated_objects,
)
from avmsf.evaluation.mode_embedding import MaterialSpace, Pitches, PitchesAndRings, UmapSettings
from avmsf.fem.material import MATERIALS
from benchmarks.report import Options, Report, Table, log
from benchmarks.step import peak_gigabytes

PARTS = ("edit",)
SEEDS = 3
STEPS, CONTACTS = 100, 4
"""Of each descent."""
NAMES = {
    "before": "before",
    "unconstrained": "unconstrained",
    "searched": "searched",
    "hierarchical": "after",
    "physics": "physics",
}
"""What keys call the methods."""
CONVENTIONS = (
    f"edit: simulated objects, four shapes in seven materials, make the clusters ({', '.join(SHAPES)}; each in a size "
    f"of its own, .7 to 1.4 times); {' and '.join(OTHER_SHAPES)}, which are in no cluster, are edited towards 16 "
    "recordings of the other of the two in the new material. Modes are the finite elements' own, Poisson's ratio .27 "
    "throughout; those within 60 dB of the loudest are compared.",
    "umap: distance to the center of the target's cluster in a UMAP of the sets of frequencies, as in the paper. "
    "umap_rings: the same of frequencies and dampings. octaves: the plain distance of the vectors. told_apart: part of "
    "the labelled objects whose nearest other is of the same material; chance would come to .11.",
    "spectral: relative STFT error from the nearest clip of the reference at equal level, mean over 8 contacts.",
    f"unconstrained: every frequency, damping and gain by itself from where the object is, at the rates of our common "
    "factors (Audio-SDS states .05 for its own parameters); searched: the same from where our search ends, so that the "
    "difference to after is the hierarchy's own share; after: one pitch and one decay, searched first, with small "
    f"shifts of single modes; {STEPS} steps of {CONTACTS} contacts each. physics: both materials' constants known, so "
    "neither baseline nor rival.",
    "megabytes: the most resident memory while editing is measured, less what was resident before, in 10^6 bytes; "
    "elsewhere than on Linux the peak of the whole process.",
)


def figures(
    *, seeds: int = SEEDS, steps: int = STEPS, kinds: Sequence[str] = SHAPES, record: Path | None = None
) -> dict[str, float]:
    """Return all figures under their keys and print the table; `record` is where the scores' JSON goes."""
    report = measure_editing(seeds=seeds, steps=steps, kinds=kinds, record=record)
    for each in report.conventions:
        print(each)
    for table in report.tables:
        print("\n".join(["", *table.lines()]))
    return dict(report.figures)


def measure(options: Options) -> Report:
    """Return the figures, or those of small settings."""
    if options.quick_look:
        return measure_editing(seeds=1, steps=5, kinds=SHAPES[:2])
    return measure_editing()


def measure_editing(
    *, seeds: int = SEEDS, steps: int = STEPS, kinds: Sequence[str] = SHAPES, record: Path | None = None
) -> Report:
    """Make the objects and their space, edit, and judge."""
    begun, resident = time.perf_counter(), _forget_peak()
    log("editing: solving shapes")
    labelled = labelled_objects(kinds)
    strangers = strange_shapes()
    spaces = spaces_of(labelled)
    log(f"editing: {len(labelled)} labelled objects after {time.perf_counter() - begun:.0f} s")
    tasks = [
        referred_task(strangers[seed % 2], strangers[1 - seed % 2], transition, seed=seed)
        for transition in SIMULATED_TRANSITIONS
        for seed in range(seeds)
    ]
    methods = towards_reference({"steps": steps, "contacts_per_step": CONTACTS})
    scores = judge(tasks, methods, spaces, progress=_tell_score)
    if record is not None:
        write_scores(scores, spaces, record)
    return _report(scores, spaces, time.perf_counter() - begun, peak_gigabytes() * 1e3 - resident)


def labelled_objects(kinds: Sequence[str] = SHAPES) -> tuple[KnownObject, ...]:
    """Return the objects that the clusters are made of, each shape in all materials."""
    return simulated_objects(tuple(SolvedShape.of(kind, seed=11) for kind in kinds))


def strange_shapes() -> tuple[SolvedShape, ...]:
    """Return the two shapes that are edited and referred to."""
    return tuple(SolvedShape.of(kind, seed=12) for kind in OTHER_SHAPES)


def spaces_of(labelled: Sequence[KnownObject], *, seed: int = 0) -> dict[str, MaterialSpace]:
    """Return where materials lie, by frequencies as in the paper and by frequencies and dampings."""
    return {
        name: MaterialSpace.of(
            [each.bank for each in labelled],
            [each.material for each in labelled],
            names=[each.name for each in labelled],
            features=features,
            settings=UmapSettings(seed=seed),
        )
        for name, features in (("pitches", Pitches()), ("rings", PitchesAndRings()))
    }


def other_recording(shape: SolvedShape, material: str, *, seed: int) -> KnownObject:
    """Return a shape in a material and in a size of its own."""
    return shape.struck(MATERIALS[material], size=drawn_size(shape.kind, material, seed=100 + seed))


def referred_task(own: SolvedShape, other: SolvedShape, transition: Transition, *, seed: int) -> EditTask:
    """Return one object to edit, with recordings of another shape in the new material."""
    edited = other_recording(own, transition.source, seed=seed)
    heard = other_recording(other, transition.target, seed=seed).impacts
    name = f"{other.kind} of {transition.target}"
    reference = Reference.of(heard.sounds, sample_rate=heard.sample_rate, name=name)
    return EditTask(edited, transition.target, reference=reference, seed=seed)


def _forget_peak() -> float:
    """Return the memory that is resident now, 10^6 bytes, and make it the peak: other parts may have had more."""
    mark = Path("/proc/self/clear_refs")
    if not mark.exists():
        return 0.0
    mark.write_text("5")
    return peak_gigabytes() * 1e3


def _report(
    scores: Sequence[EditScore], spaces: Mapping[str, MaterialSpace], seconds: float, megabytes: float
) -> Report:
    chosen: dict[str, Callable[[EditScore], float]] = {
        "umap": lambda score: score.umap["pitches"],
        "umap_rings": lambda score: score.umap["rings"],
        "octaves": lambda score: score.octaves["pitches"],
        "octaves_rings": lambda score: score.octaves["rings"],
        "spectral": lambda score: math.nan if score.spectral is None else score.spectral,
        "seconds": lambda score: score.seconds,
    }
    pairs = sorted({(score.source, score.target) for score in scores}, key=lambda pair: pair)
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for method, key in NAMES.items():
        for pair in [*pairs, None]:
            own = [
                score
                for score in scores
                if score.method == method and (pair is None or pair == (score.source, score.target))
            ]
            values = {name: mean(read(score) for score in own) for name, read in chosen.items()}
            rows.append([f"{method}, {'all' if pair is None else ' to '.join(pair)}", *values.values()])
            if pair is None:
                figures |= {f"edit.{name}_{key}": value for name, value in values.items()}
    for name, space in spaces.items():
        figures[f"edit.told_apart_{name}"] = space.nearest_neighbor_accuracy()
        for target in sorted({score.target for score in scores}):
            figures[f"edit.spread_{name}_{target}"] = space.spread(target)
    figures["edit.seconds"] = seconds
    figures["edit.megabytes"] = megabytes
    title = f"edit: distances from the target's material, mean over {len(scores) // len(NAMES)} edits (lower is better)"
    return Report(CONVENTIONS, (Table(title, ("method", *chosen), rows),), figures)


def _tell_score(score: EditScore) -> None:
    log(
        f"editing: {score.object} to {score.target}, seed {score.seed}, {score.method}: umap "
        f"{score.umap['pitches']:.2f}, with rings {score.umap['rings']:.2f}, {score.seconds:.1f} s"
    )
