"""What a field is for: other materials by physics, and edits towards a sound."""

import time
from collections.abc import Callable, Iterator
from functools import partial

from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.reference import Reference
from avmsf.evaluation.editing import Edited, guided, physics, score_edit, unedited
from avmsf.evaluation.mode_embedding import FEATURES, MaterialSpace
from avmsf.evaluation.task import EditRequest
from avmsf.fem.material import MATERIALS
from avmsf.modal.extraction.finders import HighResolution
from benchmarks.changedmaterial import change
from benchmarks.records import Measurement, Record, Settings, means, records
from benchmarks.simulatedobjects import OTHER_SHAPES, SHAPES, KnownObject, SolvedShape, drawn_size, simulated_objects

TRANSITIONS = (("ceramic", "wood"), ("glass", "steel"), ("wood", "glass"))
"""Old and new materials of the edits."""
METHODS: dict[str, Callable[[EditRequest], Edited]] = {
    "before": unedited,
    "unconstrained": partial(guided, parameters="independent"),
    "hierarchical": partial(guided, parameters="hierarchical"),
    "physics": physics,
}
"""What makes the edits, by name."""
SEEDS, STEPS, MAX_CONTACTS = range(3), 100, 8
"""Each seed takes another object, another reference and other chance; an edit is rendered at some contacts."""


def edit(settings: Settings) -> Iterator[Record]:
    """Material edits of simulated objects towards recordings of another object in the target material.

    Bowls, mugs, plates and pots in seven materials, each in a size of its own, .7 to 1.4 times, make the clusters;
    goblets and trays, which are in no cluster, are edited. Modes are the finite elements' own, Poisson's ratio .27
    throughout; those within 60 dB of the loudest are compared. Values are those of `avmsf evaluate edit`.
    neighbor_accuracy: part of the labelled objects whose nearest other is of the same material. physics: both
    materials' constants known, so no rival.
    """
    labelled = simulated_objects(SolvedShape.of(kind, seed=11) for kind in settings.some(SHAPES, 2))
    banks, materials = [each.bank for each in labelled], [each.material for each in labelled]
    names = [each.name for each in labelled]
    spaces = {each: MaterialSpace.of(banks, materials, names=names, features=each) for each in FEATURES}
    shapes = [SolvedShape.of(kind, seed=12) for kind in OTHER_SHAPES]

    def one(shape: SolvedShape, material: str, seed: int) -> KnownObject:
        return shape.struck(MATERIALS[material], size=drawn_size(shape.kind, material, seed=100 + seed))

    found: dict[str, dict[str, list[dict[str, float]]]] = {name: {} for name in METHODS}
    for source, target in TRANSITIONS:
        for seed in settings.some(SEEDS):
            known, other = one(shapes[seed % 2], source, seed), one(shapes[1 - seed % 2], target, seed)
            config = GuidedEditConfig(steps=5 if settings.quick else STEPS, seed=seed, preview_every=0)
            reference = Reference.of(other.impacts.sounds, sample_rate=other.impacts.sample_rate, name=other.name)
            request = EditRequest(known.sound_field, source, target, config, HighResolution(), reference=reference)
            contacts = known.impacts.contacts[:MAX_CONTACTS]
            for name, method in METHODS.items():
                begun = time.perf_counter()
                made = method(request)
                seconds, sounds = time.perf_counter() - begun, made.render(contacts)
                values, figures, _ = score_edit(made, sounds, contacts, request, spaces)
                distances = [each for each in values["spectral"] if each is not None]
                row = {**figures, "spectral": sum(distances) / len(distances), "seconds": seconds}
                yield from records(row, group=name, object=f"{known.name} to {target}", seed=seed)
                found[name].setdefault(f"{source} to {target}", []).append(row)
    for name, pairs in found.items():
        every = [row for rows in pairs.values() for row in rows]
        for pair, rows in {**pairs, "all": every}.items():
            yield from records({**means(rows), "count": len(rows)}, group=name, object=pair)
    for name, space in spaces.items():
        yield from records({"neighbor_accuracy": space.nearest_neighbor_accuracy()}, object=name)


PARTS: dict[str, Measurement] = {"change-material": change, "edit": edit}
