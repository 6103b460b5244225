"""Methods that change an object's material: the paper's, its baselines, and the laws of elasticity."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import Recording
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
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
from avmsf.errors import EvaluationError
from avmsf.evaluation.editing_objects import amplitudes_of, heard_modes
from avmsf.evaluation.editing_tasks import EditTask
from avmsf.fem.material import MATERIALS
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import HighResolution, ModeFinder, ShortTime
from avmsf.modal.modes import ModalBank

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
        return heard(task.object.sound_field, task)


@dataclass(frozen=True)
class Recast:
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
        return heard(change_material(task.object.sound_field, old, new), task)


@dataclass(frozen=True, eq=False)
class Steered:
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
        return replace(heard(edited, task), previews=tuple(previews))


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
        bank = heard_modes(modes.bank, torch.complex(modes.gains.double(), modes.quadrature.double()))
        return Edited(bank, sound.float(), rate)


def towards_reference(config: Mapping[str, Any] | None = None, *, paper: bool = False) -> tuple[EditMethod, ...]:
    """Return the methods of the protocol without words.

    As it was; every mode by itself, from there and from where our search ends; ours, or the `paper`'s parameters; and
    the laws of elasticity.
    """
    settings, parameters = config or {}, PUBLISHED if paper else HIERARCHICAL
    return (
        Untouched(),
        Steered("unconstrained", _reference, INDEPENDENT, settings),
        Steered("searched", _reference, SEARCHED, settings),
        Steered(parameters.name, _reference, parameters, settings),
        Recast(),
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
        Steered("audio-sds", guide, INDEPENDENT, settings),
        Steered(parameters.name, guide, parameters, settings),
    )


def heard(edited: SoundField, task: EditTask) -> Edited:
    """Return a field's modes and sounds at the task's contacts."""
    amplitudes = amplitudes_of(edited, task.contacts)
    bank = heard_modes(edited.bank, amplitudes, sample_rate=edited.sample_rate)
    return Edited(bank, edited.render(task.contacts), edited.sample_rate)


def _reference(task: EditTask) -> Guide:
    if task.reference is None:
        raise EvaluationError.expected(
            f"one for {task.object.name} to {task.target}", name="reference", advice="give the task one"
        )
    return task.reference
