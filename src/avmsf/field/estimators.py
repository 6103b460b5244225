"""What fits gain models: the interface of estimators, and the training runs that they ask for, with checkpoints."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from avmsf._utils.checkpoint import Checkpoint
from avmsf._utils.device import steps_between_losses
from avmsf.errors import FieldFileError, FitError
from avmsf.field.gains.data import GainData
from avmsf.field.gains.model import GainModel
from avmsf.field.losses import spectral_loss
from avmsf.field.training import Targets, TrainableGains, TrainingRun
from avmsf.modal.spectra import envelope


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


class Trainer:
    """The runs of one fit, in order, with a memory of those that are done."""

    def __init__(
        self,
        identity: Mapping[str, str],
        *,
        checkpoint: str | Path | None,
        progress: Callable[[Progress], None] | None,
        device: torch.device,
    ) -> None:
        self.progress, self.device = progress, device
        # Each kind of device draws noise of its own.
        identity = {**identity, "device": device.type}
        self.checkpoint = Checkpoint(checkpoint, identity, what="the fit", raising=FieldFileError)
        state = self.checkpoint.read() or {"trials": {}, "running": None}
        self.trials: dict[str, dict[str, float]] = state["trials"]
        self.running: dict[str, Any] | None = state["running"]

    def run(
        self,
        name: str,
        network: TrainableGains,
        data: GainData,
        rows: Int[Tensor, " contacts"],
        *,
        warmup: int,
        steps: int,
        held: tuple[GainData, Int[Tensor, " held"]] | None = None,
    ) -> TrainingRun:
        """Train gains on recordings, for which they read `rows`; with `held`, note in `trials` their errors there.

        Raises FitError for a run that diverges.
        """
        # The cosine of the steps' lengths runs out where the run ends.
        config = replace(data.config, warmup_steps=warmup, steps=max(1, steps))
        run = TrainingRun(network, replace(data, config=config), self.device)
        targets = Targets.of(data, rows, self.device)
        if self.running is not None and self.running["name"] == name:
            run.resume(self.running["run"])
        end, every = warmup + steps, steps_between_losses(self.device)
        try:
            while run.step < end:
                loss = run.advance(targets)
                if run.step % every == 0 or run.step in (warmup, end):
                    self._note(Progress(name, run.step, end, float(loss), warmup))
                if self.checkpoint.due:
                    self._save(name, run)
            if held is not None:
                self.trials[name] = _errors_at(held[0], run, Targets.of(*held, self.device))
        except KeyboardInterrupt:
            # Amid a step's changes there is nothing to keep but what was saved before.
            if run.whole and run.finite:
                self._save(name, run)
            raise
        if held is None:
            # The work is done but the field is not saved yet: should that fail, it need not be done again.
            self._save(name, run)
        return run.cpu()

    def _note(self, progress: Progress) -> None:
        if not math.isfinite(progress.loss):
            got = f"{progress.loss} at step {progress.step}"
            advice = "lower learning_rate, warmup_rate or correction_rate"
            raise FitError.expected("a finite loss", progress.loss, got=got, name=progress.stage, advice=advice)
        if self.progress is not None:
            self.progress(progress)

    def _save(self, name: str, run: TrainingRun) -> None:
        # On a GPU the loss is read every few steps only: a fit may have diverged since, and could not go on from that.
        if self.checkpoint.path is not None and not run.finite:
            self._note(Progress(name, run.step, run.step, math.nan, 0))
        self.checkpoint.save({"trials": self.trials, "running": {"name": name, "run": run.state()}})


@torch.no_grad()
def _errors_at(held: GainData, run: TrainingRun, targets: Targets) -> dict[str, float]:
    """Return a run's errors at contacts that it was not trained on, relative spectral ones and ENV (paper, 4.2)."""
    sounds = run.sounds(targets.rows)
    spectral = float(spectral_loss(sounds, targets.whole)) / len(targets.whole.resolutions)
    distance = (envelope(sounds.cpu()) - envelope(held.train.sounds)).square().mean(1).sqrt().mean()
    return {"spectral": spectral, "envelope": float(distance)}


@dataclass(frozen=True, eq=False)
class FittedGains:
    """What an estimator made of recordings."""

    model: GainModel
    """Its modes are in the `order` of the run."""
    run: TrainingRun
    """With the frequencies, dampings and noise as trained."""
    used: Sequence[int]
    """Rows of the recordings that the model was fitted to."""
    report: dict[str, Any]
    """What was chosen and found, as plain values."""


class GainEstimator(ABC):
    """A frozen configuration by which a gain model is fitted."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What reports, tables and the command line call it."""

    @abstractmethod
    def digest(self) -> str:
        """Return what distinguishes this estimator from others of its name."""

    @abstractmethod
    def start(self, data: GainData) -> tuple[TrainableGains, Int[Tensor, " contacts"]]:
        """Return gains before they are trained end to end, and what they read for each contact; -1 for one left out.

        Raises AvmsfError where they cannot be had.
        """

    @abstractmethod
    def fit(self, data: GainData, trainer: Trainer) -> FittedGains:
        """Return the fitted gain model. Raises as `start` and `Trainer.run`."""
