"""Methods that edit an object's material, towards a prompt or recordings, and their scores (supplement).

Scores are the distance of the modes from those of labelled objects (`benchmarks.mode_embedding`), of the sounds from
the reference's, and, for prompts, the CLAP score; they are compared with those of the unedited object.
"""

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import Recording
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.editing.clips import level, with_length
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.distillation import DecoderDistillation
from avmsf.editing.guided import (
    HIERARCHICAL,
    INDEPENDENT,
    PUBLISHED,
    Guide,
    GuidedEditProgress,
    Parameterization,
    edit_towards,
)
from avmsf.editing.material import change_material
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError, AvmsfWarning, EvaluationError
from avmsf.evaluation.clap import Clap
from avmsf.evaluation.metrics import relative_stft_error
from avmsf.fem.material import material_named
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import HighResolution, ShortTime
from avmsf.modal.modes import ModalBank
from benchmarks.editing_objects import KnownObject, audible_modes
from benchmarks.mode_embedding import MaterialSpace

_MAX_STORED_SOUNDS = 8
"""Contacts at which an edited object is rendered."""
PROMPTS: Mapping[str, tuple[str, str]] = {
    "wood": ("a single knock on a wooden object, short and dull", "tapping a hollow wooden bowl with a mallet"),
    "glass": ("a single tap on a wine glass, clear and bright", "a glass bottle is struck once and rings"),
    "metal": ("a single strike on a metal object, ringing for long", "a hammer hits a metal pan once"),
    "steel": ("a single strike on a steel object, ringing for long", "a hammer hits a steel pipe once"),
    "iron": ("a single strike on a cast iron object, heavy and ringing", "a hammer hits an iron skillet once"),
    "plastic": ("a single knock on a plastic object, light and dull", "tapping a hollow plastic bowl with a stick"),
    "polycarbonate": (
        "a single knock on a hard polycarbonate object, short and dry",
        "tapping a polycarbonate box with a stick",
    ),
    "ceramic": ("a single tap on a ceramic cup, a short bright clink", "a porcelain bowl is struck once with a stick"),
}
"""Two prompts for each target material. The paper has two a transition and prints none: these are ours."""
Transition = tuple[str, str]
"""From one material to another."""
_Goal = TypeVar("_Goal")


@dataclass(frozen=True, eq=False)
class EditTask:
    """One requested edit."""

    object: KnownObject
    target: str
    """Material."""
    prompt: str | None = None
    """Text prompt, for methods that use it."""
    reference: Reference | None = None
    """Target sounds, for methods that use them; the spectral distance is computed to them."""
    seed: int = 0

    @property
    def contacts(self) -> Float[Tensor, "contacts 3"]:
        """Contacts of the rendered sounds."""
        return self.object.impacts.contacts[:_MAX_STORED_SOUNDS]


def _expect(goal: _Goal | None, name: str) -> _Goal:
    """Return a task's prompt or reference. Raises EvaluationError where it has none."""
    if goal is None:
        raise EvaluationError.expected("one for each task", name=name, advice="give the task one")
    return goal


def prompted_tasks(
    objects: Sequence[KnownObject], transitions: Sequence[Transition], *, seed: int = 0
) -> tuple[EditTask, ...]:
    """Return every object of a transition's source material, with each of the two prompts."""
    return tuple(
        EditTask(each, target, prompt=prompt, seed=seed)
        for source, target in transitions
        for each in objects
        if each.material == source
        for prompt in PROMPTS[target]
    )


@dataclass(frozen=True, eq=False)
class Edited:
    """Result of a method for a task."""

    bank: ModalBank
    """Audible modes."""
    sounds: Float[Tensor, "contacts samples"]
    sample_rate: float
    """Hz."""
    previews: tuple[tuple[int, Float[Tensor, " samples"]], ...] = ()
    """Steps of the edit and the sound after each, all at one contact; step 0 is the unedited object."""

    @classmethod
    def of(cls, field: SoundField, task: EditTask, **more: Any) -> "Edited":
        """Return a field's modes and sounds at the task's contacts."""
        bank = audible_modes(field.bank, field.complex_gains(task.contacts), sample_rate=field.sample_rate)
        return cls(bank, field.render(task.contacts), field.sample_rate, **more)


@dataclass(frozen=True)
class EditMethod:
    """A method that changes the material of an object's sound."""

    name: str
    """Name in tables."""
    edit: Callable[[EditTask], Edited]
    """Returns the edited object. Raises AvmsfError where it cannot."""


UNTOUCHED = EditMethod("before", lambda task: Edited.of(task.object.sound_field, task))
"""The object as it was: what an edit has to better."""


def _in_new_material(task: EditTask) -> Edited:
    old, new = (material_named(name) for name in (task.object.material, task.target))
    return Edited.of(change_material(task.object.sound_field, old, new), task)


PHYSICS = EditMethod("physics", _in_new_material)
"""The laws of elasticity with both materials' constants, which the other methods do not have."""


def guided(
    name: str, guide: Callable[[EditTask], Guide], parameters: Parameterization, settings: Mapping[str, Any]
) -> EditMethod:
    """Return guided editing; `settings` are those of `GuidedEditConfig` other than the seed, which is the task's."""

    def edit(task: EditTask) -> Edited:
        config = GuidedEditConfig(**{"preview_every": 0, **settings, "seed": task.seed})
        field, previews = task.object.sound_field, list[tuple[int, Tensor]]()

        def keep(progress: GuidedEditProgress) -> None:
            if progress.preview is not None and progress.place is not None:
                if not previews:
                    previews.append((0, field.render(progress.place[None])[0]))
                previews.append((progress.step, progress.preview))

        edited = edit_towards(field, guide(task), config=config, parameters=parameters, progress=keep)
        return Edited.of(edited, task, previews=tuple(previews))

    return EditMethod(name, edit)


GENERATED = 3.0
"""Seconds of a sound that is generated from a prompt only."""


def generation(model: StableAudio, seconds: float, *, paper: bool) -> EditMethod:
    """Return direct generation (the paper's baseline): no object at all, and the modes found from the onset on."""

    def edit(task: EditTask) -> Edited:
        rate, prompt = model.sample_rate, _expect(task.prompt, "prompt")
        made = model.generate(prompt, seconds=seconds, seed=task.seed).double().cpu()
        recording = Recording(f"generated from {prompt!r}", made[None].numpy(), rate, "FLOAT")
        sound = torch.from_numpy(np.array(prepare(recording, CaptureSettings()).sound))[None]
        modes = extract_sounds(sound, sample_rate=rate, method=ShortTime() if paper else HighResolution())
        return Edited(audible_modes(modes.bank, modes.gains.abs()), sound.float(), rate)

    return EditMethod("generation", edit)


def edit_methods(
    settings: Mapping[str, Any], *, model: StableAudio | None = None, generated: float = GENERATED, paper: bool = False
) -> tuple[EditMethod, ...]:
    """Return the methods towards recordings, or by a `model` towards words: those of the paper's table.

    Before; every mode by itself, which with words is Audio-SDS; ours, or the `paper`'s parameters; and physics, or
    direct generation of so many seconds. `settings` are those of `GuidedEditConfig`.
    """
    parameters = PUBLISHED if paper else HIERARCHICAL

    def guide(task: EditTask) -> Guide:
        if model is None:
            return _expect(task.reference, "reference")
        rate = task.object.sound_field.sample_rate
        return DecoderDistillation(model, _expect(task.prompt, "prompt"), sample_rate=rate)

    single = guided("unconstrained" if model is None else "audio-sds", guide, INDEPENDENT, settings)
    ours = guided(parameters.name, guide, parameters, settings)
    if model is None:
        return UNTOUCHED, single, ours, PHYSICS
    return UNTOUCHED, generation(model, generated, paper=paper), single, ours


@dataclass(frozen=True)
class EditScore:
    """Scores of one method in one task."""

    method: str
    object: str
    source: str
    target: str
    prompt: str | None
    seed: int
    umap: Mapping[str, float]
    """Distance to the center of the target's cluster, by the names of the spaces; in UMAP's units."""
    places: Mapping[str, tuple[float, float]]
    """Position of the modes in each space, by the names of the spaces; in UMAP's units."""
    spectral: float | None
    """Mean relative STFT error of the sounds from the nearest clip of the reference, at equal level."""
    seconds: float
    """Time of the edit."""
    clap: float | None = None
    """Mean cosine of the sounds and the prompt."""
    clap_curve: tuple[tuple[int, float], ...] = ()
    """The same after some steps, at one contact; step 0 is the unedited object."""


def score_edits(
    tasks: Sequence[EditTask],
    methods: Sequence[EditMethod],
    spaces: Mapping[str, MaterialSpace],
    *,
    clap: Clap | None = None,
) -> tuple[EditScore, ...]:
    """Return every method's scores in every task. The time of fitting an object's field does not count.

    A sound without an impact or without modes, and a method that fails, have no score, and a warning says so: a
    generative model may return anything.
    """
    scores = []
    for task in tasks:
        _ = task.object.sound_field
        for method in methods:
            begun = time.perf_counter()
            try:
                made = method.edit(task)
            except AvmsfError as error:
                name = f"{task.object.name} to {task.target}, {method.name}"
                warnings.warn(AvmsfWarning(f"{name}: no score, since {error}", name=name), stacklevel=2)
                continue
            score = _score(task, method.name, made, spaces, time.perf_counter() - begun)
            if clap is not None and task.prompt is not None:
                cosine = float(clap.score(made.sounds, [task.prompt], sample_rate=made.sample_rate).mean())
                score = replace(score, clap=cosine, clap_curve=_clap_curve(made, task.prompt, clap))
            scores.append(score)
    return tuple(scores)


def _score(task: EditTask, method: str, made: Edited, spaces: Mapping[str, MaterialSpace], seconds: float) -> EditScore:
    places = {name: space.place(made.bank) for name, space in spaces.items()}
    return EditScore(
        method,
        task.object.name,
        task.object.material,
        task.target,
        task.prompt,
        task.seed,
        {name: space.distance(places[name], task.target) for name, space in spaces.items()},
        {name: (float(place[0]), float(place[1])) for name, place in places.items()},
        None if task.reference is None else spectral_distance(made, task.reference),
        seconds,
    )


def _clap_curve(made: Edited, prompt: str, clap: Clap) -> tuple[tuple[int, float], ...]:
    """Return the steps of an edit's previews and their CLAP scores; silent previews have none."""
    previews = [(step, sound) for step, sound in made.previews if bool(sound.any())]
    if not previews:
        return ()
    scores = clap.score(torch.stack([sound for _, sound in previews]), [prompt], sample_rate=made.sample_rate)
    return tuple((step, float(score)) for (step, _), score in zip(previews, scores, strict=True))


def spectral_distance(made: Edited, reference: Reference) -> float:
    """Return the mean over sounds of the relative STFT error from the nearest clip, all clips at the sound's level.

    Free of level; 0 for a sound that is one of the clips, 1 for silence. Raises EvaluationError for another rate.
    """
    if made.sample_rate != reference.sample_rate:
        raise EvaluationError.expected(f"{made.sample_rate:g} Hz", reference.sample_rate, name="reference")
    clips = with_length(reference.clips, made.sounds.shape[1])
    sounds, wanted = (
        each.double() / level(each.double(), sample_rate=made.sample_rate)[:, None] for each in (made.sounds, clips)
    )
    rate = made.sample_rate
    errors = [relative_stft_error(sounds, clip.expand_as(sounds), sample_rate=rate) for clip in wanted]
    return float(torch.stack(errors).amin(dim=0).mean())
