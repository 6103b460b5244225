"""From recordings, features and modes to a sound field."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.device import TRAINABLE, steps_between_losses, usable_device
from avmsf._utils.state import read_checkpoint, write_checkpoint
from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import AvmsfWarning, FieldFileError, FitError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.gains.model import GainModel
from avmsf.field.gains.refinement import RefinedGains
from avmsf.field.losses import spectral_loss
from avmsf.field.quality import with_quality
from avmsf.field.recipes import GainCase, GainRecipe, along_phase, fingerprint, gain_case
from avmsf.field.sound_field import SUPPORTING, Origin, SoundField
from avmsf.field.training import Targets, TrainableGains, TrainingRun
from avmsf.gaussians.points import farthest_points
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual, estimate_residual
from avmsf.modal.spectra import envelope

_MIN_PLACES = 6
_CHECKPOINT_SECONDS = 30.0
_VALIDATION_STEPS = 10
"""Steps between validations."""


@dataclass(frozen=True)
class Progress:
    """Where a fit stands."""

    stage: str
    """Name of what is being done."""
    step: int
    """Steps done of this run."""
    steps: int
    """Steps of this run."""
    loss: float
    """Loss of the last step: relative squared gain error in warm-up, spectral loss after."""
    warmup: int
    """Steps of this run that are warm-up: each takes a small part of the time of one end to end."""


def fit(
    train: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig | None = None,
    *,
    gains: GainRecipe | None = None,
    capture: str = "",
    settings: CaptureSettings | None = None,
    checkpoint: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
    device: torch.device | str | None = None,
    supporting: Sequence[int] | None = None,
) -> SoundField:
    """Fit a sound field to recordings (paper, section 3.5).

    `modes` as extracted from `train`, or `random_modes` where there is no warm-up. `gains` makes the gain model; the
    default is the Gaussian process without elastic mode shapes (`MixtureEstimator`), since the object's shape is not
    known here. `settings` are the capture's; the field stores them, and recordings to be located are read by them. What
    the config leaves open is chosen on held-out training contacts, then the field is fitted to all. With `checkpoint`,
    the state is saved there during the fit, on interruption and at the end, and a fit of the same arguments continues
    from it to the same result; delete the file once the field is saved. The network and the spectral loss are trained
    on `device`, by default a CUDA GPU where there is one, with the same result up to rounding; clusters, the Gaussian
    process and the field are on the CPU. `supporting` are the rows of `modes` that are not modes of the object, for
    `SoundField.is_mode`. Raises `FitError` for arguments that do not fit together, a fit that diverges
    and a device that cannot be used, `FieldFileError` for a checkpoint of another fit.
    """
    config = FitConfig() if config is None else config
    settings = CaptureSettings() if settings is None else settings
    if train.before is not None and bool(train.before.isnan().all()):
        # Files that start with their impacts were not cut, and others are to be read alike.
        settings = replace(settings, align=False)
    case = gain_case(train, features, modes, config)
    train = case.train
    recipe = MixtureEstimator() if gains is None else gains
    place = usable_device(device, raising=FitError, kinds=TRAINABLE)
    job = _Job(case, recipe, None if checkpoint is None else Path(checkpoint), progress, place)
    chosen, report = job.choose()
    run = job.run("fit", list(range(len(train))), chosen)
    # Close modes may have passed one another on the way.
    order = torch.argsort(run.bank.frequency.detach())
    report = {"gain_model": recipe.name, **run.network.report, **report}
    if supporting is not None:
        report[SUPPORTING] = [row for row, found in enumerate(order.tolist()) if found in supporting]
    bank = ModalBank(*(each.detach()[order] for each in (run.bank.frequency, run.bank.damping)))
    field = SoundField(
        bank,
        _finished(run.network, order, bank, case),
        case.phase[order],
        Residual(run.residual.magnitude.detach().clone()),
        train.sample_rate,
        train.sounds.shape[1],
        Origin(capture, train.names, train.forces is not None, config, report, settings),
        modes.alignment,
    )
    used = train.take(run.network.used_rows(len(train)))
    if config.residual and not config.noise_rate and config.steps:
        field = _with_measured_residual(field, used)
    return with_quality(field, used, advise=features.on_surface)


def _finished(network: TrainableGains, order: Int[Tensor, " modes"], bank: ModalBank, case: GainCase) -> GainModel:
    """Return trained gains with their modes in this order, those of the Gaussian process with their measured noise."""
    if not isinstance(network, RefinedGains):
        return network.finished(order)
    parts = along_phase(*fit_gains(case.train.sounds, bank, sample_rate=case.train.sample_rate), case.phase[order])
    return network.finished_with(order, torch.view_as_complex(parts.contiguous()))


def _with_measured_residual(field: SoundField, train: Impacts) -> SoundField:
    """Return the field with the noise measured from what its modes do not explain of the recordings."""
    bins = len(field.residual.magnitude)
    silent = replace(field, residual=Residual(torch.zeros(bins)))
    modes = silent.render(train.contacts, directions=train.directions)
    return replace(field, residual=estimate_residual(train.sounds, modes, bins=bins))


@dataclass(frozen=True)
class _Plan:
    """A run's free choices."""

    damping: str
    steps: int


class _Job:
    """The runs of one fit, in order, with a memory of those that are done."""

    def __init__(
        self,
        case: GainCase,
        recipe: GainRecipe,
        checkpoint: Path | None,
        progress: Callable[[Progress], None] | None,
        device: torch.device,
    ) -> None:
        self.device = device
        self.case, self.recipe, self.checkpoint, self.progress = case, recipe, checkpoint, progress
        self.train = case.train
        # Where nothing has to be learned first, the run starts end to end.
        warmup = case.config.warmup_steps if recipe.warms_up else 0
        self.config = case.config if warmup else replace(case.config, warmup_steps=0, steps=max(1, case.config.steps))
        self.steps = case.config.steps
        self.rows = recipe.rows(case)
        # Each kind of device draws noise of its own.
        self.identity = {"input, configuration or version": fingerprint(case, recipe), "device": device.type}
        saved = (
            None
            if checkpoint is None
            else read_checkpoint(checkpoint, self.identity, what="a fit", raising=FieldFileError)
        )
        self.trials: dict[str, Any] = {} if saved is None else saved["trials"]
        self.running: dict[str, Any] | None = None if saved is None else saved["running"]
        self.saved_at = time.monotonic()

    def choose(self) -> tuple[_Plan, dict[str, Any]]:
        """Return what the config leaves open, decided on validation contacts, and how it was decided."""
        dampings = self.recipe.dampings(self.config)
        default = _Plan(dampings[0], self.steps)
        held = held_out(self.train.contacts, self.config.validation)
        undecided = len(dampings) > 1 or (self.config.patience > 0 and self.recipe.warms_up)
        few = len(rows_by_place(self.train.contacts)) < _MIN_PLACES
        reason = {"damping_reason": self._damping_reason(dampings, few=few, held=held)}
        if few or not held or not undecided:
            return default, {"damping": default.damping, "validated": False, **reason}
        learned = [row for row in range(len(self.train)) if row not in held]
        for damping in dampings:
            name = f"trial with {damping} damping"
            if name not in self.trials:
                self.run(name, learned, _Plan(damping, self.steps), held=held)
        outcomes = {damping: self.trials[f"trial with {damping} damping"] for damping in dampings}
        best = min(outcomes, key=lambda damping: outcomes[damping]["envelope"])
        steps = outcomes[best]["steps"] if self.config.patience else self.steps
        report = {
            "damping": best,
            "validated": True,
            **reason,
            "validation_contacts": [self.train.names[row] for row in held],
            "validation_envelope": {damping: each["envelope"] for damping, each in outcomes.items()},
            "validation_spectral": {damping: each["spectral"] for damping, each in outcomes.items()},
            "steps": steps,
        }
        return _Plan(best, steps), report

    def _damping_reason(self, dampings: tuple[str, ...], *, few: bool, held: list[int]) -> str:
        """Return why the damping has the form that it has."""
        if self.config.damping in dampings:
            return "as set"
        if len(dampings) == 1:
            return "the only form of this gain model"
        if few:
            return f"fewer than {_MIN_PLACES} positions leave none to validate on"
        return "chosen on validation contacts" if held else "no positions are held out to validate on"

    def run(self, name: str, learned: list[int], plan: _Plan, *, held: list[int] | None = None) -> TrainingRun:
        """Train on the rows `learned`; with `held`, note how well the best step does there."""
        run = self._start(learned, plan)
        # A recording of another position than its label would pull the others' gains to its sound.
        targets = self._targets([learned[place] for place in run.network.used_rows(len(learned))])
        validation = None if held is None else _Validation(self._targets(held), self.train.sounds[held], self.config)
        if self.running is not None and self.running["name"] == name:
            run.resume(self.running["run"])
            if validation is not None:
                validation.best = self.running["validation"]
        end, every = self.config.warmup_steps + plan.steps, steps_between_losses(self.device)
        try:
            while True:
                # First in the loop, so that a run which goes on takes the validation that an interruption may have cut
                # off; a second one at the same step changes nothing.
                if (validation is not None and validation.stops(run, end)) or run.step >= end:
                    break
                loss = run.advance(targets)
                if run.step % every == 0 or run.step in (self.config.warmup_steps, end):
                    self._note(Progress(name, run.step, end, float(loss), self.config.warmup_steps))
                if time.monotonic() - self.saved_at > _CHECKPOINT_SECONDS:
                    self._save(name, run, validation)
        except KeyboardInterrupt:
            # Amid a step's changes there is nothing to keep but what was saved before.
            if run.whole and run.finite:
                self._save(name, run, validation)
            raise
        if validation is not None:
            best = validation.best
            self.trials[name] = {**best, "steps": max(0, best["steps"] - self.config.warmup_steps)}
        else:
            # The work is done but the field is not saved yet: should that fail, it need not be done again.
            self._save(name, run, None)
        run.end()
        return run

    def _note(self, progress: Progress) -> None:
        if not math.isfinite(progress.loss):
            raise FitError(
                f"{progress.stage}: expected a finite loss, got {progress.loss} at step {progress.step}; lower "
                "learning_rate, warmup_rate or correction_rate",
                name=progress.stage,
                value=progress.loss,
            )
        if self.progress is not None:
            self.progress(progress)

    def _start(self, learned: list[int], plan: _Plan) -> TrainingRun:
        case = self.case.take(learned)
        # The cosine runs out where the plan ends, for a run that is meant to end early as well.
        config = replace(self.config, steps=max(1, plan.steps))
        return TrainingRun(
            self.recipe.start(case, plan.damping),
            case.modes,
            gains=case.gains.to(self.device),
            phase=case.phase,
            sample_rate=self.train.sample_rate,
            samples=self.train.sounds.shape[1],
            config=config,
        )

    def _targets(self, rows: list[int]) -> Targets:
        return Targets.of(self.train.take(rows), self.case.gains[rows].to(self.device), self.rows[rows], self.config)

    def _save(self, name: str, run: TrainingRun, validation: "_Validation | None") -> None:
        if self.checkpoint is None:
            return
        # On a GPU the loss is read every few steps only: a fit may have diverged since, and could not go on from that.
        if not run.finite:
            self._note(Progress(name, run.step, run.step, math.nan, 0))
        running = {"name": name, "run": run.state(), "validation": None if validation is None else validation.best}
        state = {"trials": self.trials, "running": running}
        try:
            write_checkpoint(self.checkpoint, state, self.identity, raising=FieldFileError)
        except FieldFileError as error:
            # A full disk costs the checkpoint, not the fit.
            message = f"{error}; the fit continues without a new checkpoint"
            warnings.warn(AvmsfWarning(message, file=error.file, value=error.value), stacklevel=2)
        self.saved_at = time.monotonic()


class _Validation:
    """Held-out contacts, and how well a run predicts them: at its best step with patience, or at its last."""

    def __init__(self, targets: Targets, sounds: Float[Tensor, "contacts samples"], config: FitConfig) -> None:
        self.targets, self.envelope, self.config = targets, envelope(sounds), config
        self.best: dict[str, Any] = {"spectral": float("inf"), "envelope": float("inf"), "steps": 0}

    def stops(self, run: TrainingRun, end: int) -> bool:
        """Note the errors where it is time, relative and ENV (paper, 4.2); return whether patience is at its end."""
        done = run.step - self.config.warmup_steps
        if done < 0 or (done % _VALIDATION_STEPS and run.step != end):
            return False
        # Validation must not disturb the run: its noise comes from the same place in the stream every time.
        state = run.generator.get_state()
        with torch.no_grad():
            sounds = run.sounds(self.targets.rows)
            spectral = float(spectral_loss(sounds, self.targets.whole)) / len(self.targets.whole.hops)
            distance = float((envelope(sounds.cpu()) - self.envelope).square().mean(1).sqrt().mean())
        run.generator.set_state(state)
        if not self.config.patience or spectral < self.best["spectral"]:
            self.best = {"spectral": spectral, "envelope": distance, "steps": run.step}
        return self.config.patience > 0 and run.step - self.best["steps"] >= self.config.patience


def held_out(contacts: Float[Tensor, "contacts 3"], fraction: float) -> list[int]:
    """Return all rows of the places, a fraction of all, that farthest-point sampling takes last.

    Of single rows it would take repeats last, whose places are trained on.
    """
    rows = rows_by_place(contacts)
    order = farthest_points(contacts[[each[0] for each in rows]], len(rows)).tolist()
    return [row for place in order[len(rows) - round(fraction * len(rows)) :] for row in rows[place]]
