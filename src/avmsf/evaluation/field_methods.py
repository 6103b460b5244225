"""The sound field as a method: a configuration of the whole pipeline with a name, and what is left without a part."""

from dataclasses import dataclass, replace

import torch

from avmsf.capture.impacts import Impacts
from avmsf.evaluation.random_modes import random_modes
from avmsf.evaluation.task import Look, Method, Task
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction, extract_sounds
from avmsf.modal.extraction.finders import finder_named
from avmsf.pipeline.config import PipelineConfig

NETWORK = PipelineConfig(gain_model="network")
"""The attention network with the quick settings of the fit."""


@dataclass(frozen=True)
class FieldMethod:
    """A field fitted as a configuration of the pipeline says.

    Seed and device are the evaluation's, and the sounds start as in the task's recordings.
    """

    name: str
    """What tables call it."""
    pipeline: PipelineConfig = NETWORK
    """Settings of all stages."""
    look: Look = "visual"
    """What is read of the object's points."""
    published: bool = False
    """Whether modes are found as `pipeline` says, in place of those that all methods share, and recordings are located
    by the cosine distance of gains as it is published."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where modes, features or field cannot be made."""
        return self.fitted(task, task.train, task.features(self.look), self.modes(task), self.pipeline.fit)

    def modes(self, task: Task) -> Extraction:
        """Return the modes of a task's training recordings."""
        if not self.published:
            return task.modes()
        finder = finder_named(self.pipeline.extraction, self.pipeline.modes)
        return extract_sounds(task.train.sounds, sample_rate=task.train.sample_rate, method=finder)

    def fitted(
        self, task: Task, train: Impacts, features: FeatureField, modes: Extraction, config: FitConfig
    ) -> SoundField:
        """Fit the field to some of a task's recordings, in whose modes they are rows."""
        # An object of few points has no more regions than points.
        clusters = min(config.clusters, len(torch.unique(features.points, dim=0)))
        gains = estimator_for(self.pipeline.gain_model, task.bodies)
        config = replace(config, clusters=clusters, seed=task.seed)
        return fit(train, features, modes, config, gains=gains, capture=task.name, device=task.device)


@dataclass(frozen=True)
class FieldVariant:
    """A field that is fitted in another way than its method says, and has the method's name and features."""

    method: FieldMethod
    """What it differs from."""

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.method.name

    @property
    def look(self) -> Look:
        """What is read of the object's points."""
        return self.method.look


@dataclass(frozen=True)
class UninformedField(FieldVariant):
    """A field without modal initialization (the paper's row "w/o init"): no extracted modes and no warm-up.

    It starts from `random_modes`, with as many modes and bands of noise as the extraction has, and is trained end to
    end for as many steps as the method takes in all. Corrections have `correction_rate`, for here they are no
    corrections: frequencies, dampings and noise have to find where they belong.
    """

    correction_rate: float = 0.03
    """Adam's step for frequencies (in widths of their modes) and for the logarithms of dampings."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where features or field cannot be made, or no mode can be counted."""
        counted = self.method.modes(task)
        start = random_modes(
            task.train,
            modes=len(counted.bank),
            bins=len(counted.residual.magnitude),
            generator=torch.Generator().manual_seed(task.seed),
        )
        config = self.method.pipeline.fit
        steps = config.warmup_steps + config.steps
        config = replace(config, warmup_steps=0, steps=steps, correction_rate=self.correction_rate)
        return self.method.fitted(task, task.train, task.features(self.look), start, config)


def configured(method: Method) -> FieldMethod | None:
    """Return the configuration that a method fits, or starts from; None for methods without one."""
    found = method.method if isinstance(method, FieldVariant) else method
    return found if isinstance(found, FieldMethod) else None
