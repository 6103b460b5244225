"""The sound field as a method: the paper's form, and what is left when a part of it is taken away."""

from dataclasses import dataclass, replace

import torch

from avmsf.bench.task import Look, Task
from avmsf.capture.impacts import Impacts
from avmsf.field.config import FitConfig, GainModel
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.recipes import Attention, GainRecipe
from avmsf.field.soundfield import SoundField
from avmsf.modal.extraction.extract import Extraction, extract_sounds
from avmsf.modal.extraction.finders import ModeFinder
from avmsf.modal.extraction.random_modes import random_modes
from avmsf.scene.features import FeatureField

QUICK = FitConfig()
"""The quick recipe."""


@dataclass(frozen=True)
class FieldMethod:
    """A field with the attention network, fitted to extracted modes."""

    name: str
    """What tables call it."""
    config: FitConfig = QUICK
    """Settings of the fit, but for the seed, which is the task's."""
    look: Look = "visual"
    """What the network reads of the object's points."""
    finder: ModeFinder | None = None
    """How modes are found; None takes those that all methods share."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where modes, features or field cannot be made."""
        return fit_field(task, task.train, task.features(self.look), modes_of(task, self.finder), self.config)


@dataclass(frozen=True)
class MixtureField:
    """A field whose gains are a Gaussian process over kernel families."""

    name: str
    """What tables call it."""
    model: GainModel = "auto"
    """All families, or one."""
    config: FitConfig = QUICK
    """Settings of the fit, but for the seed, which is the task's."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where modes or field cannot be made, or the one family cannot be had."""
        gains = estimator_for(self.model, task.bodies)
        return fit_field(task, task.train, task.features("positions"), task.modes(), self.config, gains=gains)


@dataclass(frozen=True)
class UninformedField:
    """A field without modal initialization (the paper's row "w/o init"): no extracted modes and no warm-up.

    It starts from `random_modes`, with as many modes and bands of noise as the extraction has, and is trained end to
    end for as many steps as the recipe takes in all. Corrections have `correction_rate`, for here they are no
    corrections: frequencies, dampings and noise have to find where they belong.
    """

    name: str
    """What tables call it."""
    config: FitConfig = QUICK
    """Settings of the recipe whose steps are all taken end to end."""
    correction_rate: float = 0.03
    """Adam's step for frequencies (in widths of their modes) and for the logarithms of dampings."""
    look: Look = "visual"
    """What the network reads of the object's points."""
    finder: ModeFinder | None = None
    """How modes are counted; None takes those that all methods share."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where features or field cannot be made, or no mode can be counted."""
        counted = modes_of(task, self.finder)
        start = random_modes(
            task.train,
            modes=len(counted.bank),
            bins=len(counted.residual.magnitude),
            generator=torch.Generator().manual_seed(task.seed),
        )
        steps = self.config.warmup_steps + self.config.steps
        config = replace(self.config, warmup_steps=0, steps=steps, correction_rate=self.correction_rate)
        return fit_field(task, task.train, task.features(self.look), start, config)


def modes_of(task: Task, finder: ModeFinder | None) -> Extraction:
    """Return the modes of a task's training blows: those that all methods share, or what another finder makes."""
    if finder is None:
        return task.modes()
    return extract_sounds(task.train.sounds, sample_rate=task.train.sample_rate, method=finder)


def fit_field(
    task: Task,
    train: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig,
    *,
    gains: GainRecipe | None = None,
) -> SoundField:
    """Fit a field to some of a task's blows, in whose modes they are rows, by the network unless told otherwise."""
    # An object of few points has no more regions than points.
    clusters = min(config.clusters, len(torch.unique(features.points, dim=0)))
    recipe = Attention() if gains is None else gains
    config = replace(config, clusters=clusters, seed=task.seed)
    return fit(train, features, modes, config, gains=recipe, capture=task.name, device=task.device)
