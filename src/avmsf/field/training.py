"""Estimators of gain models and their training runs: warm-up, then all parameters end to end (paper, section 3.5)."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.optim.adamw import adamw

from avmsf._utils.checkpoint import Checkpoint
from avmsf._utils.device import TRAINABLE, steps_between_losses, without_denormals
from avmsf.capture.impacts import Impacts
from avmsf.errors import FieldFileError, FitError
from avmsf.field.gains.data import GainData
from avmsf.field.gains.model import GainModel, Gains
from avmsf.field.losses import SpectralTarget, spectral_loss, spectral_target
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual, shape_noise
from avmsf.modal.spectra import envelope


@dataclass(frozen=True, eq=False)
class Targets:
    """Recordings as the losses compare them: their gains, and their spectra, whole and at the beginning."""

    rows: Int[Tensor, " contacts"]
    """What the gains read for the contacts."""
    gains: Float[Tensor, "contacts modes"]
    """Extracted gains, the warm-up's aim."""
    whole: SpectralTarget
    early: SpectralTarget

    @classmethod
    def of(cls, data: GainData, rows: Int[Tensor, " contacts"], device: torch.device | str = "cpu") -> "Targets":
        """Prepare recordings with the config's resolutions, on a device."""
        config = data.config
        sizes, hops, length = config.resolutions(data.train.sample_rate)
        sounds = data.train.sounds.to(device)
        whole = spectral_target(sounds, fft_sizes=sizes, hops=hops)
        early = spectral_target(sounds, fft_sizes=sizes, hops=hops, samples=length)
        if config.spectral_norm == "common":
            mean = sum(float(each.norms.sum()) for each in whole.resolutions) / len(sizes)
            # Divided evenly among a resolution's frames.
            for each in (*whole.resolutions, *early.resolutions):
                each.norms[:] = mean / len(each.norms)
        return cls(rows.to(device), data.gains.to(device), whole, early)


class AdamW:
    """Steps of AdamW (Loshchilov and Hutter, ICLR 2019), by torch's function.

    Torch's class imports torch's compiler when it is first made, which takes two seconds, a sixth of a fit.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], rate: float, weight_decay: float = 0.0) -> None:
        """`rate` is the length of a step at first; at each, parameters shrink by `weight_decay` times the rate."""
        self.parameters, self.rate, self.weight_decay = tuple(parameters), rate, weight_decay
        self.moments = [[torch.zeros_like(each, requires_grad=False) for each in parameters] for _ in range(2)]
        """All that changes besides the parameters: means of the gradients and of their squares, and steps."""
        self.moments.append([torch.zeros((), device=each.device) for each in parameters])

    @torch.no_grad()
    def step(self, factor: float) -> None:
        """Move all parameters that have gradients, at `factor` times the rate."""
        rows = [row for row, parameter in enumerate(self.parameters) if parameter.grad is not None]
        means, squares, steps = ([each[row] for row in rows] for each in self.moments)
        adamw(
            [self.parameters[row] for row in rows],
            [parameter.grad for parameter in self.parameters if parameter.grad is not None],
            means, squares, [], steps, lr=factor * self.rate, weight_decay=self.weight_decay, beta1=0.9, beta2=0.999,
            eps=1e-8, amsgrad=False, maximize=False, fused=True,
        )  # fmt: skip

    def resume(self, moments: Sequence[Sequence[Tensor]]) -> None:
        """Go back to `moments` of before, from whichever device."""
        for mine, others in zip(self.moments, moments, strict=True):
            mine[:] = [to.to(at.device, copy=True) for to, at in zip(others, mine, strict=True)]


class TrainableGains(nn.Module, ABC):
    """Gains in training. Matrices decay towards zero as the config asks for, other parameters do not."""

    @abstractmethod
    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at the contacts that `Targets.rows` stands for, differentiable in the parameters."""

    def penalty(self) -> Float[Tensor, ""]:
        """Return the negative log prior of the parameters, in the unit of the spectral loss."""
        return torch.zeros(())


class TrainingRun(nn.Module):
    """Parameters on their way: gains, small corrections to the bank and residual, and their optimizers.

    The corrections are measured in what the recordings resolve: frequencies in their modes' widths, dampings and noise
    magnitudes as logarithms. So one learning rate serves all, and dampings and magnitudes stay positive. All tensors
    are on one device; a step waits for none of them.
    """

    def __init__(self, network: TrainableGains, data: GainData, device: torch.device | str = "cpu") -> None:
        super().__init__()
        config, bank, gains, magnitude = data.config, data.modes.bank, data.gains, data.modes.residual.magnitude
        self.config, self.sample_rate, self.samples = config, data.train.sample_rate, data.train.sounds.shape[1]
        self.network, self.phase = network, nn.Buffer(data.phase)
        self.frequency, self.damping, self.magnitude = (
            nn.Buffer(each) for each in (bank.frequency, bank.damping, magnitude)
        )
        # Modes weigh in the warm-up by the energy of a unit gain over time, or alike (paper).
        energy = 1 / (4 * bank.damping) if config.warmup_weights == "energy" else torch.ones_like(bank.damping)
        energy = energy.to(gains)
        total = (gains.square().mean(0) * energy).sum().clamp_min(torch.finfo(gains.dtype).tiny)
        self.weight = nn.Buffer(energy / total)
        self.width = nn.Buffer(torch.clamp(bank.damping / (2 * math.pi), min=self.sample_rate / self.samples))
        # A correction beyond half the mode's own frequency would mean that another mode is sought.
        self.lowest = nn.Buffer(bank.frequency / 2)
        self.highest = nn.Buffer(torch.clamp(bank.frequency * 1.5, max=0.499 * self.sample_rate))
        self.shift, self.decay = (nn.Parameter(torch.zeros_like(bank.frequency)) for _ in range(2))
        self.noise = nn.Parameter(torch.zeros_like(magnitude))
        self.to(device)
        kind = self.phase.device.type
        self.generator = torch.Generator(self.phase.device if kind in TRAINABLE else "cpu").manual_seed(config.seed)
        matrices = [parameter for parameter in network.parameters() if parameter.ndim == 2]
        vectors = [parameter for parameter in network.parameters() if parameter.ndim != 2]

        def of_network(rate: float) -> list[AdamW]:
            return [AdamW(matrices, rate, config.weight_decay), AdamW(vectors, rate)]

        self.warmup, self.joint = of_network(config.warmup_rate), of_network(config.learning_rate)
        self.joint.append(AdamW([self.shift, self.decay], config.correction_rate))
        if config.residual and config.noise_rate:
            self.joint.append(AdamW([self.noise], config.noise_rate))
        self.step = 0
        self.whole = True
        """False while parameters are being moved: an interruption then leaves a state that nothing can go on from."""
        self._chance = self.generator.get_state()

    @property
    def bank(self) -> ModalBank:
        """The modes as they stand."""
        moved = torch.clamp(self.frequency + self.width * self.shift, self.lowest, self.highest)
        return ModalBank(moved, self.damping * torch.exp(self.decay))

    @property
    def order(self) -> Int[Tensor, " modes"]:
        """The modes by frequency: close ones may have passed one another on the way."""
        return torch.argsort(self.bank.frequency.detach())

    @property
    def trained(self) -> ModalBank:
        """The modes as they stand, in this order, without gradients."""
        bank = self.bank
        return ModalBank(bank.frequency.detach(), bank.damping.detach()).take(self.order)

    @property
    def finite(self) -> bool:
        """Whether all parameters are finite numbers; waits for the device."""
        return all(bool(each.isfinite().all()) for each in self.parameters())

    @property
    def residual(self) -> Residual:
        """The noise as it stands."""
        if not self.config.residual:
            return Residual(torch.zeros_like(self.magnitude))
        return Residual(self.magnitude * torch.exp(self.noise))

    def sounds(self, rows: Int[Tensor, " contacts"]) -> Float[Tensor, "contacts samples"]:
        """Return the sounds at what the gains read, with a fresh draw of noise (paper, eq. 12)."""
        gains, bank = self.network.read(rows), self.bank
        sounds = synthesize(
            gains.mean,
            bank.frequency,
            gains.dampings(bank.damping),
            self.phase,
            samples=self.samples,
            sample_rate=self.sample_rate,
        )
        if not self.config.residual:
            return sounds
        return sounds + shape_noise(
            self.residual.magnitude, contacts=len(rows), samples=self.samples, generator=self.generator
        )

    @without_denormals()
    def advance(self, targets: Targets) -> Float[Tensor, ""]:
        """Take one step on all contacts and return the loss before it, of the frames whose turn it is."""
        if self.step < self.config.warmup_steps:
            # The squared error of the gains (paper, eq. 13), over their mean square.
            off = self.network.read(targets.rows).mean.real - targets.gains
            loss = (off.square() * self.weight).sum(1).mean()
            optimizers, done = self.warmup, self.step / self.config.warmup_steps
        else:
            loss = self.spectral_loss(targets)
            optimizers, done = self.joint, (self.step - self.config.warmup_steps) / self.config.steps
        self.zero_grad()
        torch.autograd.backward(loss)
        self.whole = False
        for each in optimizers:
            each.step(0.55 + 0.45 * math.cos(math.pi * done))
        self.step += 1
        self._chance = self.generator.get_state()
        self.whole = True
        return loss.detach()

    def spectral_loss(self, targets: Targets) -> Float[Tensor, ""]:
        """Return the loss on whole sounds and on their beginnings (paper, eq. 14), and the gains' penalty.

        Of the frames those are compared whose turn it is.
        """
        sounds, every = self.sounds(targets.rows), self.config.interleave
        whole, early = (
            spectral_loss(sounds, target, first=self.step % every, every=every)
            for target in (targets.whole, targets.early)
        )
        return torch.add(whole, early, alpha=self.config.early_weight) + self.network.penalty()

    def state(self) -> dict[str, Any]:
        """Return all that decides how the run goes on after its last whole step: tensors, numbers, containers of these.

        An interruption in the middle of a step may call for it too, while `whole`: only the noise has moved on by then.
        """
        return {
            "parameters": self.state_dict(),
            "moments": [each.moments for each in (*self.warmup, *self.joint)],
            "generator": self._chance,
            "step": self.step,
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go back to what `state` returned."""
        self.load_state_dict(state["parameters"])
        for each, moments in zip((*self.warmup, *self.joint), state["moments"], strict=True):
            each.resume(moments)
        self._chance = state["generator"]
        self.generator.set_state(self._chance)
        self.step = state["step"]


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
    train: Impacts
    """The recordings that the model was fitted to, over the levels that were found of those without forces."""
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
    def fit(self, data: GainData, trainer: Trainer) -> FittedGains:
        """Return the fitted gain model. Raises as `Trainer.run`, and AvmsfError where the model cannot be had."""
