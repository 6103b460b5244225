"""The sound field as a method: a configuration of the whole pipeline with a name, its ablations, and a grid search."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

import torch

from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.errors import FitError
from avmsf.evaluation.metrics import envelope_distance
from avmsf.evaluation.task import Task, VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig, GainModelName
from avmsf.field.fit import fit
from avmsf.field.gains.attention import held_out
from avmsf.field.gains.estimator import estimator_for
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction, extract_sounds
from avmsf.modal.extraction.finders import finder_named, lowest_frequency
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.pipeline.config import PRESETS, PipelineConfig

NETWORK = PipelineConfig(gain_model="network")
"""The attention network with the quick settings of the fit."""
_MIN_VALIDATED_POSITIONS = 6
"""Training positions from which on a part of them is held out to choose settings by, as in `fit` itself."""
_UNINFORMED_RATE = 0.03
"""Adam's step for frequencies (in widths of their modes) and for the logarithms of dampings without extracted modes:
frequencies, dampings and noise have to find where they belong."""
_MAX_FREQUENCY_RATIO = 0.9
"""Highest random frequency over half the sample rate."""
_MIN_QUALITY = 10.0
"""Quality factor, pi f / d, of the fastest random decay."""
_NOISE_RATIO = 0.01
"""Noise beside random modes over the sounds' root mean square: 40 dB down."""


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
        values = asdict(self)
        for chosen in itertools.product(*values.values()):
            yield replace(base, **dict(zip(values, chosen, strict=True)))


PAPER_GRID = Grid((128, 256, 512), (1e-2, 5e-3, 1e-3), (5000, 10000, 20000), (0.5, 1.0, 2.0))
"""The paper's lists (supplement, training setup): 162 fits an object, to run where there is time for them."""
QUICK_GRID = Grid((8, 16, 32), (3e-3, 1e-3), (150,), (1.0,))
"""What of it matters at the quick recipe's sizes: 12 fits an object."""


@dataclass(frozen=True)
class FieldMethod:
    """A field fitted as a configuration of the pipeline says, with the evaluation's seed and device.

    Unless `informed` it has no modal initialization (the paper's row "w/o init"): it starts from `random_modes`, as
    many as the extraction has, and is trained end to end for as many steps as the configuration takes in all.

    With a `grid`, its settings are chosen on the quarter of the training positions that farthest-point sampling takes
    last: every candidate is fitted to the others and scored there by ENV (paper, supplement), and the best, of equals
    the first, is fitted to all training contacts. With fewer than six positions the configuration's own settings are
    taken. Modes are those of all training contacts.
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
    informed: bool = True
    """Whether it starts from extracted modes."""
    grid: Grid | None = None
    """Settings to choose from."""

    def fit(self, task: Task) -> SoundField:
        """Fit the field, whose report has what was chosen. Raises AvmsfError where a stage cannot be made."""
        features, modes, config = task.features(self.visual_input), self._modes(task), self.pipeline.fit
        report: dict[str, Any] = {}
        if self.grid is not None:
            config, report["grid"] = self._choose(self.grid, task, features, modes)
        if not self.informed:
            count, bins = len(modes.bank), len(modes.residual.magnitude)
            generator = torch.Generator().manual_seed(task.seed)
            modes = random_modes(task.train, modes=count, bins=bins, generator=generator)
            steps = config.warmup_steps + config.steps
            config = replace(config, warmup_steps=0, steps=steps, correction_rate=_UNINFORMED_RATE)
        field = self._fitted(task, task.train, features, modes, config)
        return replace(field, origin=replace(field.origin, report={**field.origin.report, **report}))

    def _modes(self, task: Task) -> Extraction:
        if not self.published:
            return task.modes()
        finder = finder_named(self.pipeline.extraction, self.pipeline.modes)
        return extract_sounds(task.train.sounds, sample_rate=task.train.sample_rate, method=finder)

    def _fitted(
        self, task: Task, train: Impacts, features: FeatureField, modes: Extraction, config: FitConfig
    ) -> SoundField:
        """Fit the field to some of a task's recordings, in whose modes they are rows."""
        # An object of few points has no more regions than points.
        clusters = min(config.clusters, len(torch.unique(features.points, dim=0)))
        gains = estimator_for(self.pipeline.gain_model, task.bodies)
        config = replace(config, clusters=clusters, seed=task.seed)
        return fit(train, features, modes, config, gains=gains, capture=task.name, device=task.device)

    def _choose(
        self, grid: Grid, task: Task, features: FeatureField, modes: Extraction
    ) -> tuple[FitConfig, dict[str, Any]]:
        """Return the best settings of a grid, and the report of the choice."""
        base, train = self.pipeline.fit, task.train
        rows = held_out(train.contacts, base.validation)
        if len(rows_by_place(train.contacts)) < _MIN_VALIDATED_POSITIONS or not rows:
            return base, {"validated": False}
        learnt, held = [row for row in range(len(train)) if row not in rows], train.take(rows)
        candidates, errors = list(grid.candidates(base)), []
        for config in candidates:
            field = self._fitted(task, train.take(learnt), features, modes.take(learnt), config)
            sounds = field.render(held.contacts, directions=held.directions)
            errors.append(float(envelope_distance(sounds, held.sounds, sample_rate=held.sample_rate).mean()))
        chosen = candidates[min(range(len(candidates)), key=errors.__getitem__)]
        return chosen, {
            "validated": True,
            "validation_contacts": list(held.names),
            "validation_envelope": errors,
            "chosen": {each.name: getattr(chosen, each.name) for each in fields(grid)},
        }


def gaussian_process(name: str, *, model: GainModelName) -> FieldMethod:
    """Return a Gaussian process over all kernel families, or over one."""
    return FieldMethod(name, PipelineConfig(gain_model=model), "surface")


def network(
    name: str,
    visual_input: VisualInput,
    *,
    published: bool = False,
    informed: bool = True,
    grid: bool = False,
    **fit: Any,
) -> FieldMethod:
    """Return the attention network with the quick settings, or those of the preset `paper`, but for those of `fit`.

    `published` has one of the preset's two dampings, shared unless `fit` names the other.
    """
    base, candidates = (PRESETS["paper"], PAPER_GRID) if published else (NETWORK, QUICK_GRID)
    settings = {"damping": "shared", **fit} if published else fit
    pipeline = replace(base, fit=replace(base.fit, **settings))
    return FieldMethod(name, pipeline, visual_input, published, informed, candidates if grid else None)


def random_modes(train: Impacts, *, modes: int, bins: int, generator: torch.Generator) -> Extraction:
    """Return modes drawn at random in place of extracted ones, with flat noise of `bins` bands.

    Frequencies are spread evenly over their logarithm, from the lowest that the sounds' length allows (17 Hz in 3 s) to
    nine tenths of half the sample rate; dampings likewise, from a fall by one neper over the whole sound to a quality
    factor of 10. All gains are equal, and the modes have the energy of the mean sound, which with the rate and the
    length is all that is taken from `train`. Raises FitError for too short recordings.
    """
    rate, samples = train.sample_rate, train.sounds.shape[1]
    lowest, highest = lowest_frequency(samples, rate), _MAX_FREQUENCY_RATIO * rate / 2
    if lowest >= highest:
        got, advice = f"{samples} samples", "use more seconds after the onset"
        raise FitError.expected("longer recordings", samples, got=got, name="train", advice=advice)
    chance = torch.rand(2, modes, dtype=torch.float64, generator=generator)
    frequency = torch.sort(lowest * (highest / lowest) ** chance[0]).values
    slowest = rate / samples
    fastest = torch.clamp(math.pi * frequency / _MIN_QUALITY, min=slowest)
    damping = slowest * (fastest / slowest) ** chance[1]
    power = float(train.sounds.double().square().mean())
    # A mode of gain one has the energy 1 / (4 d) over time, and so the mean power 1 / (4 d) over the duration.
    gain = math.sqrt(power * train.duration / float((1 / (4 * damping)).sum()))
    gains = torch.full((len(train), modes), gain) + 0j
    residual = Residual(torch.full((bins,), _NOISE_RATIO * math.sqrt(power)))
    return Extraction(ModalBank(frequency, damping), gains, residual)
