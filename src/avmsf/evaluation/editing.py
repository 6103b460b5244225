"""Evaluation of material edits: the paper's protocol, its baselines, and one without prompts (supplement).

An object of one material is edited towards another, by a prompt or by recordings of objects of that material. Scores
are the distance of its modes from those of labelled objects (`avmsf.evaluation.mode_embedding`), of its sounds from the
reference's, and, for prompts, the CLAP score; they are compared with those of the unedited object.
"""

import json
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.capture.audio import Recording
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.editing.clips import level, with_length
from avmsf.editing.config import DistillationConfig, GuidedEditConfig
from avmsf.editing.distillation import AudioDiffusion, DecoderDistillation
from avmsf.editing.guided import (
    HIERARCHICAL,
    INDEPENDENT,
    PUBLISHED,
    SEARCHED,
    Guide,
    GuidedEditProgress,
    Parameterization,
    edit_towards,
)
from avmsf.editing.material import change_material
from avmsf.editing.reference import Reference
from avmsf.errors import AvmsfWarning, CaptureError, EditError, EvaluationError, ExtractionError
from avmsf.evaluation.clap import Clap
from avmsf.evaluation.editing_objects import KnownObject, amplitudes_of, audible_modes
from avmsf.evaluation.metrics import default_fft_sizes
from avmsf.evaluation.mode_embedding import MaterialSpace
from avmsf.fem.material import MATERIALS
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import HighResolution, ModeFinder, ShortTime
from avmsf.modal.modes import ModalBank
from avmsf.modal.spectra import magnitude_stft

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


@dataclass(frozen=True)
class Transition:
    """From one material to another."""

    source: str
    target: str

    @property
    def prompts(self) -> tuple[str, str]:
        """Prompts for the target. Raises EvaluationError for a material without prompts."""
        if self.target not in PROMPTS:
            raise EvaluationError(
                f"expected a target with prompts, {', '.join(PROMPTS)}, got {self.target!r}",
                name="target",
                value=self.target,
            )
        return PROMPTS[self.target]


RECORDED_TRANSITIONS = (
    Transition("ceramic", "wood"),
    Transition("wood", "ceramic"),
    Transition("wood", "glass"),
    Transition("glass", "metal"),
)
"""Contrasting pairs for the 26 objects. The paper shows the first two and calls the others contrastive: ours."""
SIMULATED_TRANSITIONS = (Transition("ceramic", "wood"), Transition("glass", "steel"), Transition("wood", "glass"))
"""Those that are evaluated with recordings as target and several seeds."""
_RING = ("ceramic", "wood", "glass", "steel", "plastic", "iron", "polycarbonate")
SEVEN_TRANSITIONS = tuple(Transition(*pair) for pair in zip(_RING, (*_RING[1:], _RING[0]), strict=True))
"""Every one of the seven simulated materials is left once and reached once, by a neighbor that it contrasts with."""


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

    def words(self) -> str:
        """Return the prompt. Raises EvaluationError where there is none."""
        if self.prompt is None:
            raise EvaluationError.expected(
                f"one for {self.object.name} to {self.target}", name="prompt", advice="give the task one"
            )
        return self.prompt


def prompted_tasks(
    objects: Sequence[KnownObject], transitions: Sequence[Transition], *, seed: int = 0
) -> tuple[EditTask, ...]:
    """Return every object of a transition's source material, with each of the two prompts."""
    return tuple(
        EditTask(each, transition.target, prompt=prompt, seed=seed)
        for transition in transitions
        for each in objects
        if each.material == transition.source
        for prompt in transition.prompts
    )


GENERATED = 3.0
"""Seconds of a sound that is generated from a prompt only."""


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


@runtime_checkable
class EditMethod(Protocol):
    """A method that changes the material of an object's sound."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def edit(self, task: EditTask) -> Edited:
        """Return the edited object. Raises AvmsfError where it cannot."""
        ...


@dataclass(frozen=True)
class Untouched:
    """The object as it was: what an edit has to better."""

    name: str = "before"

    def edit(self, task: EditTask) -> Edited:
        """Return the object's own sounds."""
        return edited_at(task.object.sound_field, task)


@dataclass(frozen=True)
class MaterialChange:
    """The laws of elasticity with both materials' constants, which the other methods do not have."""

    name: str = "physics"

    def edit(self, task: EditTask) -> Edited:
        """Return the object in the new material. Raises EvaluationError for a material without constants."""
        for material in (task.object.material, task.target):
            if material not in MATERIALS:
                raise EvaluationError(
                    f"expected a material of {', '.join(MATERIALS)}, got {material!r}", name="material", value=material
                )
        old, new = MATERIALS[task.object.material], MATERIALS[task.target]
        return edited_at(change_material(task.object.sound_field, old, new), task)


@dataclass(frozen=True, eq=False)
class Guided:
    """Guided editing with a parameterization."""

    name: str
    guide: Callable[[EditTask], Guide]
    parameters: Parameterization
    config: Mapping[str, Any] = field(default_factory=dict)
    """Settings of `GuidedEditConfig` other than the seed, which is the task's."""

    def edit(self, task: EditTask) -> Edited:
        """Return the steered object."""
        config = GuidedEditConfig(**{"preview_every": 0, **self.config, "seed": task.seed})
        field, previews = task.object.sound_field, list[tuple[int, Tensor]]()

        def keep(progress: GuidedEditProgress) -> None:
            if progress.preview is not None and progress.place is not None:
                if not previews:
                    previews.append((0, field.render(progress.place[None])[0]))
                previews.append((progress.step, progress.preview))

        edited = edit_towards(field, self.guide(task), config=config, parameters=self.parameters, progress=keep)
        return replace(edited_at(edited, task), previews=tuple(previews))


@runtime_checkable
class TextToAudio(Protocol):
    """A model that makes a sound from words alone."""

    @property
    def sample_rate(self) -> float:
        """Hz."""
        ...

    def generate(self, prompt: str, *, seconds: float, seed: int) -> Float[Tensor, " samples"]:
        """Return a mono sound."""
        ...


@dataclass(frozen=True, eq=False)
class Generation:
    """Direct generation (the paper's baseline): no object at all, and the modes extracted from what is made."""

    model: TextToAudio
    seconds: float = GENERATED
    finder: ModeFinder = field(default_factory=HighResolution)
    """How modes are found in the sound."""
    name: str = "generation"

    def edit(self, task: EditTask) -> Edited:
        """Return the generated sound from its onset on, and its modes. Raises as preparing and extracting do."""
        rate = self.model.sample_rate
        made = self.model.generate(task.words(), seconds=self.seconds, seed=task.seed).double().cpu()
        recording = Recording(f"generated from {task.words()!r}", made[None].numpy(), rate, "FLOAT")
        sound = torch.from_numpy(np.array(prepare(recording, CaptureSettings()).sound))[None]
        modes = extract_sounds(sound, sample_rate=rate, method=self.finder)
        bank = audible_modes(modes.bank, torch.complex(modes.gains.double(), modes.quadrature.double()))
        return Edited(bank, sound.float(), rate)


def towards_reference(config: Mapping[str, Any] | None = None, *, paper: bool = False) -> tuple[EditMethod, ...]:
    """Return the methods of the protocol without words.

    As it was; every mode by itself, from there and from where our search ends; ours, or the `paper`'s parameters; and
    the laws of elasticity.
    """
    settings, parameters = config or {}, PUBLISHED if paper else HIERARCHICAL
    return (
        Untouched(),
        Guided("unconstrained", _reference, INDEPENDENT, settings),
        Guided("searched", _reference, SEARCHED, settings),
        Guided(parameters.name, _reference, parameters, settings),
        MaterialChange(),
    )


def towards_words(
    model: AudioDiffusion,
    config: Mapping[str, Any] | None = None,
    *,
    distillation: DistillationConfig | None = None,
    generated: float = GENERATED,
    paper: bool = False,
) -> tuple[EditMethod, ...]:
    """Return the methods of the paper's table: as it was, generation (of a model that can), Audio-SDS, and ours.

    `config` are settings of `GuidedEditConfig`; `generated` is how many seconds direct generation makes. The `paper`'s
    form has its parameters of an edit, and its extraction from generated sounds.
    """

    def guide(task: EditTask) -> Guide:
        rate = task.object.sound_field.sample_rate
        return DecoderDistillation(model, task.words(), sample_rate=rate, config=distillation)

    settings = config or {}
    finder: ModeFinder = ShortTime() if paper else HighResolution()
    parameters = PUBLISHED if paper else HIERARCHICAL
    generation = (Generation(model, generated, finder),) if isinstance(model, TextToAudio) else ()
    return (
        Untouched(),
        *generation,
        Guided("audio-sds", guide, INDEPENDENT, settings),
        Guided(parameters.name, guide, parameters, settings),
    )


def edited_at(edited: SoundField, task: EditTask) -> Edited:
    """Return a field's modes and sounds at the task's contacts."""
    amplitudes = amplitudes_of(edited, task.contacts)
    bank = audible_modes(edited.bank, amplitudes, sample_rate=edited.sample_rate)
    return Edited(bank, edited.render(task.contacts), edited.sample_rate)


def _reference(task: EditTask) -> Guide:
    if task.reference is None:
        raise EvaluationError.expected(
            f"one for {task.object.name} to {task.target}", name="reference", advice="give the task one"
        )
    return task.reference


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
    octaves: Mapping[str, float]
    """The same without UMAP, in octaves."""
    spectral: float | None
    """Mean relative STFT error of the sounds from the nearest clip of the reference, at equal level."""
    clap: float | None
    """Mean cosine of the sounds and the prompt."""
    seconds: float
    """Time of the edit."""
    places: Mapping[str, tuple[float, float]]
    """Position of the modes in each space, by the names of the spaces; in UMAP's units."""
    clap_curve: tuple[tuple[int, float], ...] = ()
    """Steps of the edit and the CLAP score after each, at one contact; step 0 is the unedited object."""


def judge(
    tasks: Sequence[EditTask],
    methods: Sequence[EditMethod],
    spaces: Mapping[str, MaterialSpace],
    *,
    clap: Clap | None = None,
    progress: Callable[[EditScore], None] | None = None,
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
            except (CaptureError, ExtractionError, EditError, EvaluationError) as error:
                warnings.warn(
                    AvmsfWarning(
                        f"{task.object.name} to {task.target}, {method.name}: no score, since {error}",
                        **{**error.attributes, "name": f"{task.object.name} to {task.target}, {method.name}"},
                    ),
                    stacklevel=2,
                )
                continue
            seconds = time.perf_counter() - begun
            said: float | None = None
            curve: tuple[tuple[int, float], ...] = ()
            if clap is not None and task.prompt is not None:
                said = float(clap.score(made.sounds, [task.prompt], sample_rate=made.sample_rate).mean())
                curve = clap_curve(made, task.prompt, clap)
            places = {name: space.place(made.bank) for name, space in spaces.items()}
            scores.append(
                EditScore(
                    method.name,
                    task.object.name,
                    task.object.material,
                    task.target,
                    task.prompt,
                    task.seed,
                    {name: space.distance(places[name], task.target) for name, space in spaces.items()},
                    {name: space.plain_distance(made.bank, task.target) for name, space in spaces.items()},
                    None if task.reference is None else spectral_distance(made, task.reference),
                    said,
                    seconds,
                    {name: (float(place[0]), float(place[1])) for name, place in places.items()},
                    curve,
                )
            )
            if progress is not None:
                progress(scores[-1])
    return tuple(scores)


def clap_curve(made: Edited, prompt: str, clap: Clap) -> tuple[tuple[int, float], ...]:
    """Return the steps of an edit's previews and their CLAP scores; silent previews have none."""
    previews = [(step, sound) for step, sound in made.previews if bool(sound.any())]
    if not previews:
        return ()
    scores = clap.score(torch.stack([sound for _, sound in previews]), [prompt], sample_rate=made.sample_rate)
    return tuple((step, float(score)) for (step, _), score in zip(previews, scores, strict=True))


def write_scores(scores: Sequence[EditScore], spaces: Mapping[str, MaterialSpace], path: Path) -> None:
    """Write scores and the embeddings that they rest on to one JSON file. Raises EvaluationError where it cannot."""
    record = {
        "scores": [asdict(score) for score in scores],
        "spaces": {name: space.record() for name, space in spaces.items()},
    }
    text = json.dumps(record, allow_nan=False, indent=1)
    write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=EvaluationError)


def spectral_distance(made: Edited, reference: Reference) -> float:
    """Return the mean over sounds of the relative STFT error from the nearest clip, all clips at the sound's level.

    Free of level; 0 for a sound that is one of the clips, 1 for silence. Raises EvaluationError for another rate.
    """
    if made.sample_rate != reference.sample_rate:
        raise EvaluationError(
            f"expected a reference at {made.sample_rate:g} Hz, got {reference.sample_rate:g} Hz; resample one of them",
            name="reference",
            value=reference.sample_rate,
        )
    clips = with_length(reference.clips, made.sounds.shape[1]).double()
    leveled, wanted = (
        sounds / level(sounds, sample_rate=made.sample_rate)[:, None] for sounds in (made.sounds.double(), clips)
    )
    sizes = default_fft_sizes(made.sample_rate)
    errors = torch.zeros(len(leveled), len(wanted), dtype=torch.float64)
    for size in sizes:
        own, aims = (magnitude_stft(sounds, fft_size=size, hop=max(1, size // 4)) for sounds in (leveled, wanted))
        sums = torch.stack([(one - aims).abs().sum(dim=(1, 2)) for one in own])
        errors += sums / aims.sum(dim=(1, 2)) / len(sizes)
    return float(errors.amin(dim=1).mean())
