"""A training step of the paper's full setting: ours, the plain form beside it, and the memory that ours takes.

`python -m benchmarks.step` takes a few of our steps and prints its own peak memory as JSON.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.field.attention import AttentionGains
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.losses import SpectralTarget
from avmsf.field.training import Targets, TrainingRun, gain_scale
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.residual import Residual, shape_noise
from avmsf.modal.synthesis import synthesize
from avmsf.scene.features import FeatureField
from avmsf.simulate.plate import sample_contacts
from benchmarks.material import IMPULSE, REPOSITORY

STEPS = replace(PAPER, warmup_steps=100, spectral_norm="each", damping="shared")
"""The paper's settings but for a short warm-up, enough for gains of a trained field's size, and relative losses."""
_RATE = 44100.0
_MODES = 128
_CONTACTS = 10


class PlainRun(TrainingRun):
    """The same run written as one would at first: one product with a table of atoms, all gradients by autograd."""

    def sounds(self, rows: Int[Tensor, " contacts"]) -> Float[Tensor, "contacts samples"]:
        """Return what a `TrainingRun` does, within float32's error of the phase."""
        gains = self.network.read(rows).mean
        times = torch.arange(self.samples, dtype=torch.float32) / self.sample_rate
        frequency, damping = self.bank.frequency.float(), self.bank.damping.float()
        atoms = torch.exp(-damping[:, None] * times) * torch.sin(2 * math.pi * frequency[:, None] * times)
        noise = shape_noise(self.residual.magnitude, contacts=len(rows), samples=self.samples, generator=self.generator)
        return gains @ atoms + noise

    def spectral_loss(self, targets: Targets) -> Float[Tensor, ""]:
        """Return what a `TrainingRun` does."""
        sounds = self.sounds(targets.rows)
        return _distance(sounds, targets.whole) + self.config.early_weight * _distance(sounds, targets.early)


def _distance(sounds: Float[Tensor, "contacts samples"], target: SpectralTarget) -> Float[Tensor, ""]:
    loss = sounds.new_zeros(())
    for magnitudes, hop in zip(target.magnitudes, target.hops, strict=True):
        fft_size = 2 * (magnitudes.shape[2] - 1)
        spectra = torch.stft(
            sounds[:, : target.samples],
            fft_size,
            hop,
            window=torch.hann_window(fft_size),
            center=True,
            pad_mode="constant",
            return_complex=True,
        )
        # Both lie frame by frame in memory: turning them costs nothing.
        loss = loss + (spectra.abs().mT - magnitudes).abs().sum() / magnitudes.sum()
    return loss


def full_setting(seconds: float) -> tuple[Impacts, FeatureField, Extraction]:
    """Return 10 recordings of 128 known modes and noise at 44.1 kHz, with what is fitted to them; seed 0."""
    generator = torch.Generator().manual_seed(0)
    samples = round(seconds * _RATE)
    contacts = sample_contacts(IMPULSE.plate, _CONTACTS, generator=generator)
    frequency = 200.0 * 80.0 ** torch.rand(_MODES, generator=generator, dtype=torch.float64).sort().values
    bank = ModalBank(frequency, 5.0 + 1e-3 * frequency)
    gains = torch.randn(_CONTACTS, _MODES, generator=generator)
    residual = Residual(torch.full((513,), 0.03))
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=_RATE)
    sounds += shape_noise(residual.magnitude, contacts=_CONTACTS, samples=samples, generator=generator)
    names = tuple(f"{row:02d}" for row in range(_CONTACTS))
    impacts = Impacts(contacts, sounds, _RATE, names)
    return impacts, IMPULSE.features(), Extraction(bank, gains, residual, torch.zeros_like(gains))


def start(
    impacts: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig,
    *,
    spatial_damping: bool = False,
    kind: type[TrainingRun] = TrainingRun,
) -> tuple[TrainingRun, Targets]:
    """Return a run before its first step, and what it is to be fitted to."""
    gains = fit_sine_gains(impacts.sounds, modes.bank, sample_rate=impacts.sample_rate)
    network = AttentionGains(
        features,
        gain_scale=gain_scale(gains),
        shape=replace(config.shape, spatial_damping=spatial_damping),
        generator=torch.Generator().manual_seed(config.seed),
    )
    samples = impacts.sounds.shape[1]
    run = kind(
        network,
        modes,
        gains=gains,
        phase=torch.zeros_like(modes.bank.frequency),
        sample_rate=impacts.sample_rate,
        samples=samples,
        config=config,
    )
    return run, Targets.of(impacts, gains, features.nearest(impacts.contacts), config)


def pass_warmup(run: TrainingRun, targets: Targets) -> None:
    """Take a run's steps on the extracted gains."""
    while run.step < run.config.warmup_steps:
        run.advance(targets)


def memory_of_step(seconds: float) -> dict[str, float]:
    """Return the peak memory of our step in a process of its own, 10^9 bytes: `total`, and `imports` before it."""
    command = [sys.executable, "-m", "benchmarks.step", "--seconds", str(seconds)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def peak_gigabytes() -> float:
    """Return the most memory that this process has held, 10^9 bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # On Linux a new process's ru_maxrss begins at its parent's peak; the high-water mark is its own.
        mark = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(mark.split()[1]) * 1024 / 1e9
    # macOS counts in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e9


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3.0)
    seconds = parser.parse_args().seconds
    imports = peak_gigabytes()
    run, targets = start(*full_setting(seconds), STEPS)
    pass_warmup(run, targets)
    for _ in range(3):
        run.advance(targets)
    print(json.dumps({"total": peak_gigabytes(), "imports": imports}))


if __name__ == "__main__":
    _main()
