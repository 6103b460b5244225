"""The paper's protocol of editing: `python -m benchmarks.editingprotocol DATASET`, or with `--simulated` in its place.

On 26 objects of RealImpact, of which those that were not downloaded are left out and named, or on simulated objects of
seven materials. With `--model` and `--clap` towards words, as the paper does it: each object of a transition's first
material with two prompts for the second, by direct generation, Audio-SDS (every mode by itself) and ours, evaluated by
the CLAP score and the UMAP distance. Without a model towards recordings of another object of the second material, which
needs no weights.
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from avmsf.capture.impacts import Impacts
from avmsf.datasets import open_dataset
from avmsf.datasets.dataset import Dataset
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.clap import Clap
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.results import write_json
from avmsf.fem.material import MATERIALS
from avmsf.field.gains.attention import Attention
from avmsf.modal.extraction.extract import extract_modes, extract_sounds
from avmsf.modal.extraction.finders import ShortTime
from avmsf.pipeline.config import DINO, PRESETS
from avmsf.pipeline.features import choose_encoder
from benchmarks.editing import (
    GENERATED,
    PHYSICS,
    EditScore,
    EditTask,
    Transition,
    edit_methods,
    prompted_tasks,
    score_edits,
)
from benchmarks.editing_objects import PUBLISHED, REALIMPACT_26, KnownObject
from benchmarks.editingfigures import write_figures
from benchmarks.mode_embedding import FEATURES, MaterialSpace
from benchmarks.records import Record, Settings, markdown, means, records
from benchmarks.simulatedobjects import OTHER_SHAPES, SHAPES, SolvedShape, drawn_size, simulated_objects

RECORDED_TRANSITIONS = (("ceramic", "wood"), ("wood", "ceramic"), ("wood", "glass"), ("glass", "metal"))
"""Contrasting pairs for the 26 objects. The paper shows the first two and calls the others contrastive: ours."""
SIMULATED_TRANSITIONS: tuple[Transition, ...] = (("ceramic", "wood"), ("glass", "steel"), ("wood", "glass"))
"""Those that are evaluated with recordings as target and several seeds."""
_RING = ("ceramic", "wood", "glass", "steel", "plastic", "iron", "polycarbonate")
SEVEN_TRANSITIONS: tuple[Transition, ...] = tuple(zip(_RING, (*_RING[1:], _RING[0]), strict=True))
"""Every one of the seven simulated materials is left once and reached once, by a neighbor that it contrasts with."""
MIN_OBJECTS = 8
"""Objects that an embedding of materials needs to mean anything."""
PREVIEWS = 20
"""Sounds of each edit of which the CLAP score is taken, about, for its curve over the steps."""
EDITING_UMAP = {"Generation": 3.077, "Audio-SDS": 4.234, "AV-MSF": 2.753}
"""The paper's UMAP distance to the target material after an edit, by what it calls the method. Its choice of objects
and prompts is not published, and every set of objects has another UMAP."""
SEEDS, STEPS = range(3), 100
"""Of the part `edit`: each seed takes another object, another reference and other chance."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Objects whose modes make the clusters, and what is asked of some."""

    name: str
    labelled: tuple[KnownObject, ...]
    tasks: tuple[EditTask, ...]
    known: bool
    """Whether the constants of the objects' materials are: else the laws of elasticity have nothing to go by."""
    missing: tuple[str, ...] = ()
    """Objects of the protocol that the dataset lacks."""


def edit(settings: Settings) -> Iterator[Record]:
    """Material edits of simulated objects towards recordings of another object in the target material.

    Bowls, mugs, plates and pots in seven materials, each in a size of its own, .7 to 1.4 times, make the clusters;
    goblets and trays, which are in no cluster, are edited. Modes are the finite elements' own, Poisson's ratio .27
    throughout; those within 60 dB of the loudest are compared. umap: distance to the center of the target's cluster by
    frequencies, as in the paper; umap_rings: with dampings; clap: mean cosine of sounds and prompt; spectral: relative
    STFT error from the nearest clip of the reference, at equal level. neighbor_accuracy: part of the labelled objects
    whose nearest other is of the same material. physics: both materials' constants known, so no rival.
    """
    if settings.quick:
        return measure(simulated_cast(SIMULATED_TRANSITIONS, SEEDS[:1], kinds=SHAPES[:2]), steps=5)
    return measure(simulated_cast(SIMULATED_TRANSITIONS, SEEDS), steps=STEPS)


def measure(
    cast: Cast,
    *,
    model: StableAudio | None = None,
    clap: Clap | None = None,
    steps: int | None = None,
    generated: float = GENERATED,
    seed: int = 0,
    paper: bool = False,
    scores: Path | None = None,
    figures: Path | None = None,
) -> Iterator[Record]:
    """Yield the scores of all methods, mean over edits and by transition.

    Towards the tasks' prompts by a model, else towards their references. All scores and the embeddings that they rest
    on go to the JSON file `scores`, and what the paper draws of them to `figures`. Raises AvmsfError as the methods do.
    """
    spaces = {name: _space(cast.labelled, name, seed) for name in FEATURES}
    settings: dict[str, Any] = {} if steps is None else {"steps": steps}
    if clap is not None:
        settings["preview_every"] = max(1, (steps or GuidedEditConfig().steps) // PREVIEWS)
    methods = edit_methods(settings, model=model, generated=generated, paper=paper)
    methods = tuple(each for each in methods if cast.known or each is not PHYSICS)
    found = []
    for score in (each for task in cast.tasks for each in score_edits([task], methods, spaces, clap=clap)):
        found.append(score)
        name = f"{score.object} to {score.target}"
        yield from records(_values(score), group=score.method, object=name, seed=score.seed, note=score.prompt or "")
    for method in methods:
        own = [each for each in found if each.method == method.name]
        for pair in dict.fromkeys((each.source, each.target) for each in own):
            rows = [_values(each) for each in own if (each.source, each.target) == pair]
            yield from records({**means(rows), "count": len(rows)}, group=method.name, object=" to ".join(pair))
        yield from records({**means(list(map(_values, own))), "count": len(own)}, group=method.name, object="all")
    for name, space in spaces.items():
        yield from records({"neighbor_accuracy": space.nearest_neighbor_accuracy()}, object=name)
    if scores is not None:
        stored = {name: space.record() for name, space in spaces.items()}
        write_json(scores, {"scores": [asdict(each) for each in found], "spaces": stored})
    if figures is not None:
        write_figures(found, spaces, figures)


def _space(objects: Sequence[KnownObject], features: str, seed: int) -> MaterialSpace:
    banks, materials = [each.bank for each in objects], [each.material for each in objects]
    return MaterialSpace.of(banks, materials, names=[each.name for each in objects], features=features, seed=seed)


def _values(score: EditScore) -> dict[str, float]:
    values = {"umap": score.umap["pitches"], "umap_rings": score.umap["rings"], "clap": score.clap}
    values |= {"spectral": score.spectral, "seconds": score.seconds}
    return {name: value for name, value in values.items() if value is not None}


def main(arguments: Sequence[str] | None = None) -> int:
    """Edit, evaluate and print; return 0, or 2 for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.editingprotocol", description=__doc__)
    parser.add_argument("dataset", type=Path, nargs="?", help="folder of RealImpact")
    parser.add_argument("--simulated", action="store_true", help="simulated objects in place of a dataset")
    parser.add_argument("--model", help="Stable Audio: a name on the hub or a folder; without it, towards recordings")
    parser.add_argument("--model-seconds", type=float, help="that the model works at in a descent; all it has without")
    parser.add_argument("--generated", type=float, default=GENERATED, help="seconds of a directly generated sound")
    parser.add_argument("--clap", help="CLAP: a name on the hub or a folder; without it, no CLAP score")
    parser.add_argument("--steps", type=int, help="of each descent; by itself what `avmsf edit` takes")
    preset = "paper: modes of section 3.4, fields trained as published, its parameters of an edit"
    parser.add_argument("--preset", choices=("default", "paper"), default="default", help=preset)
    parser.add_argument("--encoder", default=DINO, help="of --preset paper: DINOv2's name or folder, or descriptors")
    parser.add_argument("--cache", type=Path, help="folder that keeps Gaussians and features of --preset paper")
    parser.add_argument("--seed", type=int, default=0, help="of all chance")
    parser.add_argument("--record", type=Path, help="JSON file for all scores and the embeddings they rest on")
    parser.add_argument("--figures", type=Path, help="folder for figures: UMAP by transition, CLAP over the steps")
    chosen = parser.parse_args(arguments)
    if (chosen.dataset is not None) == chosen.simulated:
        parser.error("expected the folder of a dataset or --simulated, one of the two")
    if chosen.model is None and (chosen.clap, chosen.model_seconds, chosen.generated) != (None, None, GENERATED):
        parser.error("--clap, --model-seconds and --generated go with --model, which is not given")
    paper, words, seed = chosen.preset == "paper", chosen.model is not None, chosen.seed
    if paper and (chosen.simulated or chosen.cache is None):
        parser.error("--preset paper goes with the folder of a dataset and with --cache")
    try:
        # The models first: where one cannot be loaded nothing else is worth its time.
        model = None if chosen.model is None else StableAudio.load(chosen.model, seconds=chosen.model_seconds)
        clap = None if chosen.clap is None else Clap.load(chosen.clap)
        if chosen.simulated:
            cast = simulated_cast(SEVEN_TRANSITIONS, range(seed, seed + 2), words=words)
        else:
            made = (chosen.encoder, chosen.cache) if paper else None
            cast = recorded_cast(chosen.dataset, words=words, seed=seed, paper=made)
        files = {"scores": chosen.record, "figures": chosen.figures}
        extent = {"steps": chosen.steps, "generated": chosen.generated, "seed": seed, "paper": paper}
        found = []
        for each in measure(cast, model=model, clap=clap, **extent, **files):
            found.append(each)
            print(f"{each.name}, {each.object}: {each.value:.4g}", file=sys.stderr)
    except AvmsfError as error:
        print(f"benchmarks.editingprotocol: {error}", file=sys.stderr)
        return 2
    print(f"{edit.__doc__}\n{markdown(found)}\n\nmissing and left out: {', '.join(cast.missing) or 'none'}")
    print(f"umap in the paper: {', '.join(f'{title} {value:g}' for title, value in EDITING_UMAP.items())}")
    return 0


def recorded_cast(folder: Path, *, words: bool, seed: int = 0, paper: tuple[str, Path] | None = None) -> Cast:
    """Return the objects of RealImpact that are there; `paper` names an encoder and a folder for what it makes.

    With `paper` recordings start at their peaks, as in that preset. Raises AvmsfError where the dataset cannot be read
    or holds too few.
    """
    dataset = open_dataset(folder, time_zero=None if paper is None else PRESETS["paper"].time_zero)
    missing = sorted(set(REALIMPACT_26) - set(dataset.objects()))
    if len(REALIMPACT_26) - len(missing) < MIN_OBJECTS:
        found, advice = len(REALIMPACT_26) - len(missing), f"download more, such as {', '.join(missing[:3])}"
        what = f"{MIN_OBJECTS} objects of known materials or more"
        raise EvaluationError.expected(what, found, file=folder, name=dataset.name, advice=advice)
    make = _plain_object if paper is None else _paper_maker(dataset, *paper, seed=seed)
    names = [name for name in dataset.objects() if name in REALIMPACT_26]
    objects = tuple(make(name, REALIMPACT_26[name], dataset.capture(name).impacts) for name in names)
    present = {each.material for each in objects}
    transitions = [each for each in RECORDED_TRANSITIONS if {*each} <= present]
    if not transitions:
        what = f"objects of two materials, {', '.join(map(' to '.join, RECORDED_TRANSITIONS))}"
        raise EvaluationError.expected(what, tuple(sorted(present)), file=folder)
    tasks = prompted_tasks(objects, transitions, seed=seed) if words else _referred_tasks(objects, transitions, seed)
    return Cast("realimpact", objects, tasks, known=False, missing=tuple(missing))


def _plain_object(name: str, material: str, impacts: Impacts) -> KnownObject:
    """Return an object with the default's modes and a field without training."""
    return KnownObject(name, material, impacts, extract_modes(impacts))


def _paper_maker(
    dataset: Dataset, encoder: str, cache: Path, *, seed: int
) -> Callable[[str, str, Impacts], KnownObject]:
    """Return what reconstructs an object as the paper does: short-time modes, attention network, residual noise."""
    scene = PRESETS["paper"].scene
    lift = replace(scene.lift, encoder=encoder, seed=seed)
    # Before the modes of all objects: without the encoder nothing else is worth its time.
    choose_encoder(lift, log=partial(print, file=sys.stderr))
    scene = replace(scene, splat=replace(scene.splat, seed=seed), lift=lift)
    inputs, config = ObjectInputs(dataset, cache, scene, lift), replace(PUBLISHED, seed=seed)

    def make(name: str, material: str, impacts: Impacts) -> KnownObject:
        modes = extract_sounds(impacts.sounds, sample_rate=impacts.sample_rate, method=ShortTime())
        features = partial(inputs.features, name, "paper")
        return KnownObject(name, material, impacts, modes, Attention(), features, config, cache / "training" / name)

    return make


def simulated_cast(
    transitions: Sequence[Transition], seeds: Iterable[int], *, words: bool = False, kinds: Sequence[str] = SHAPES
) -> Cast:
    """Return the simulated objects: shapes in seven materials make the clusters, two others are edited.

    Towards recordings each seed edits one of the two, and the other one is the reference.
    """
    labelled = simulated_objects(SolvedShape.of(kind, seed=11) for kind in kinds)
    shapes = [SolvedShape.of(kind, seed=12) for kind in OTHER_SHAPES]

    def one(shape: SolvedShape, material: str, seed: int) -> KnownObject:
        return shape.struck(MATERIALS[material], size=drawn_size(shape.kind, material, seed=100 + seed))

    tasks: list[EditTask] = []
    for source, target in transitions:
        for seed in seeds:
            edited = one(shapes[seed % 2], source, seed)
            if words:
                tasks += prompted_tasks([edited], [(source, target)], seed=seed)
            else:
                reference = _reference_of(one(shapes[1 - seed % 2], target, seed))
                tasks.append(EditTask(edited, target, reference=reference, seed=seed))
    return Cast("simulated", labelled, tuple(tasks), known=True)


def _referred_tasks(
    objects: Sequence[KnownObject], transitions: Sequence[Transition], seed: int
) -> tuple[EditTask, ...]:
    """Return every object of a transition's source, towards an object of its target, which take turns."""
    tasks = []
    for source, target in transitions:
        targets = [each for each in objects if each.material == target]
        for number, each in enumerate(each for each in objects if each.material == source):
            reference = _reference_of(targets[number % len(targets)])
            tasks.append(EditTask(each, target, reference=reference, seed=seed))
    return tuple(tasks)


def _reference_of(known: KnownObject) -> Reference:
    return Reference.of(known.impacts.sounds, sample_rate=known.impacts.sample_rate, name=known.name)


if __name__ == "__main__":
    sys.exit(main())
