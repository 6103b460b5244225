"""The sound field as a method: a configuration of the whole pipeline with a name, its ablations, and a grid search."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch

from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.errors import FitError
from avmsf.evaluation.task import Method, Task, VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit, held_out
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction, extract_sounds
from avmsf.modal.extraction.finders import finder_named, lowest_frequency
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.modal.spectra import envelope
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
    visual_input: VisualInput = "visual"
    """What is read of the object's points."""
    published: bool = False
    """Whether modes are found as `pipeline` says, in place of those that all methods share, and recordings are located
    by the cosine distance of gains as it is published."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field. Raises AvmsfError where modes, features or field cannot be made."""
        return self.fitted(task, task.train, task.features(self.visual_input), self.modes(task), self.pipeline.fit)

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
    def visual_input(self) -> VisualInput:
        """What is read of the object's points."""
        return self.method.visual_input


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
        return self.method.fitted(task, task.train, task.features(self.visual_input), start, config)


def configured(method: Method) -> FieldMethod | None:
    """Return the configuration that a method fits, or starts from; None for methods without one."""
    found = method.method if isinstance(method, FieldVariant) else method
    return found if isinstance(found, FieldMethod) else None


_MAX_FREQUENCY = 0.9
"""Highest frequency over half the sample rate."""
_MIN_QUALITY = 10.0
"""Quality factor, pi f / d, of the fastest decay."""
_NOISE = 0.01
"""Noise over the sounds' root mean square: 40 dB down."""


def random_modes(train: Impacts, *, modes: int, bins: int, generator: torch.Generator) -> Extraction:
    """Return modes drawn at random in place of extracted ones, with flat noise of `bins` bands.

    Frequencies are spread evenly over their logarithm, from the lowest that the sounds' length allows (17 Hz in 3 s) to
    nine tenths of half the sample rate; dampings likewise, from a fall by one neper over the whole sound to a quality
    factor of 10. All gains are equal, and so large that the modes have the energy of the mean sound. Nothing but this
    energy, the rate and the length are taken from `train`. Raises FitError for fewer than one mode or two bands.
    """
    if modes < 1:
        raise FitError(f"modes: expected 1 or more, got {modes}", name="modes", value=modes)
    if bins < 2:
        raise FitError(f"bins: expected 2 bands of noise or more, got {bins}", name="bins", value=bins)
    rate, samples = train.sample_rate, train.sounds.shape[1]
    lowest, highest = lowest_frequency(samples, rate), _MAX_FREQUENCY * rate / 2
    if lowest >= highest:
        raise FitError(
            f"train: expected longer recordings, got {samples} samples; use more seconds after the onset",
            name="train",
            value=samples,
        )
    chance = torch.rand(2, modes, dtype=torch.float64, generator=generator)
    frequency = torch.sort(lowest * (highest / lowest) ** chance[0]).values
    slowest = rate / samples
    fastest = torch.clamp(math.pi * frequency / _MIN_QUALITY, min=slowest)
    damping = slowest * (fastest / slowest) ** chance[1]
    power = float(train.sounds.double().square().mean())
    # A mode of gain one has the energy 1 / (4 d) over time, and so the mean power 1 / (4 d) over the duration.
    gain = math.sqrt(power * train.duration / float((1 / (4 * damping)).sum()))
    gains = torch.full((len(train), modes), gain)
    return Extraction(
        ModalBank(frequency, damping),
        gains,
        Residual(torch.full((bins,), _NOISE * math.sqrt(power))),
        torch.zeros_like(gains),
    )


_FEWEST_TO_VALIDATE = 6
"""Training places from which on a part of them is held out to choose settings by, as in `fit` itself."""


@dataclass(frozen=True)
class Grid:
    """Values of the settings that a choice is made of; every combination is a candidate."""

    clusters: tuple[int, ...]
    learning_rate: tuple[float, ...]
    steps: tuple[int, ...]
    """Steps end to end; on a whole object's recordings a step is an epoch."""
    early_weight: tuple[float, ...]
    damping: tuple[Literal["shared", "per-contact"], ...] = ("shared", "per-contact")

    def candidates(self, base: FitConfig) -> Iterator[FitConfig]:
        """Yield `base` with every combination of the values, the last setting changing fastest."""
        names = ("clusters", "learning_rate", "steps", "early_weight", "damping")
        for values in itertools.product(*(getattr(self, name) for name in names)):
            yield replace(base, **dict(zip(names, values, strict=True)))


PAPER_GRID = Grid((128, 256, 512), (1e-2, 5e-3, 1e-3), (5000, 10000, 20000), (0.5, 1.0, 2.0))
"""The paper's lists (supplement, training setup): 162 fits an object, to run where there is time for them."""
QUICK_GRID = Grid((8, 16, 32), (3e-3, 1e-3), (150,), (1.0,))
"""What of it matters at the quick recipe's sizes: 12 fits an object."""


@dataclass(frozen=True)
class GridField(FieldVariant):
    """A field whose settings are chosen from a grid on validation contacts, a part of the training contacts alone.

    The quarter of the training places that farthest-point sampling takes last is held out; every candidate is fitted
    to the others and scored there by ENV (paper, supplement), the mean over contacts of the root mean square difference
    of envelopes. The best is fitted to all training contacts; of equals the first. With fewer than six places nothing
    is held out, and the method's own settings are taken. Modes are those of all training contacts.
    """

    grid: Grid

    def fit(self, task: Task) -> SoundField:
        """Choose and fit the field, whose report has what was chosen. Raises as FieldMethod."""
        features, modes, base = task.features(self.visual_input), self.method.modes(task), self.method.pipeline.fit
        fitted = partial(self.method.fitted, task)
        held = held_out(task.train.contacts, base.validation)
        if len(rows_by_place(task.train.contacts)) < _FEWEST_TO_VALIDATE or not held:
            return _with_report(fitted(task.train, features, modes, base), {"validated": False})
        learnt = [row for row in range(len(task.train)) if row not in held]
        candidates = list(self.grid.candidates(base))
        errors = [
            _held_out_error(
                fitted(task.train.take(learnt), features, _take(modes, learnt), config), task.train.take(held)
            )
            for config in candidates
        ]
        best = min(range(len(candidates)), key=errors.__getitem__)
        chosen = candidates[best]
        report = {
            "validated": True,
            "validation_contacts": [task.train.names[row] for row in held],
            "validation_envelope": errors,
            "chosen": {
                name: getattr(chosen, name)
                for name in ("clusters", "learning_rate", "steps", "early_weight", "damping")
            },
        }
        return _with_report(fitted(task.train, features, modes, chosen), report)


def _take(modes: Extraction, rows: list[int]) -> Extraction:
    return replace(modes, gains=modes.gains[rows], quadrature=modes.quadrature[rows])


def _held_out_error(field: SoundField, held: Impacts) -> float:
    difference = envelope(field.render(held.contacts, directions=held.directions)) - envelope(held.sounds.float())
    return float(difference.square().mean(dim=1).sqrt().mean())


def _with_report(field: SoundField, grid: dict[str, Any]) -> SoundField:
    return replace(field, origin=replace(field.origin, report={**field.origin.report, "grid": grid}))
