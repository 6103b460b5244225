"""Steps of training and of splatting: their time on a device, a plain form of the first and the memory that ours takes.

`python -m benchmarks.step` takes a few of our steps and prints its own peak memory as JSON.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.data import GainData
from avmsf.field.losses import SpectralTarget
from avmsf.field.training import Targets, TrainingRun
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import SplatProgress, splat
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual, shape_noise
from avmsf.modal.synthesis import synthesize
from benchmarks.look import pictures, shape, speckled
from benchmarks.material import IMPULSE, REPOSITORY
from benchmarks.report import Options, Report, Table
from tests.oracles.plate import sample_contacts

STEPS = replace(PAPER, warmup_steps=100, spectral_norm="each", damping="shared")
"""The paper's settings but for a short warm-up, enough for gains of a trained field's size, and relative losses."""
_MODES = 128


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
    for each in target.resolutions:
        spectra = torch.stft(
            sounds[:, : target.samples],
            len(each.window),
            each.hop,
            window=each.window,
            center=True,
            pad_mode="constant",
            return_complex=True,
        )
        # Both lie frame by frame in memory: turning them costs nothing.
        loss = loss + (spectra.abs().mT - each.magnitudes).abs().sum() / each.magnitudes.sum()
    return loss


def full_setting(
    seconds: float, *, count: int = 10, sample_rate: float = 44100.0
) -> tuple[Impacts, FeatureField, Extraction]:
    """Return `count` recordings of 128 known modes and noise, with what is fitted to them; seed 0."""
    generator = torch.Generator().manual_seed(0)
    samples = round(seconds * sample_rate)
    contacts = sample_contacts(IMPULSE.plate, count, generator=generator)
    frequency = 200.0 * 80.0 ** torch.rand(_MODES, generator=generator, dtype=torch.float64).sort().values
    bank = ModalBank(frequency, 5.0 + 1e-3 * frequency)
    gains = torch.randn(count, _MODES, generator=generator)
    residual = Residual(torch.full((513,), 0.03))
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=sample_rate)
    sounds += shape_noise(residual.magnitude, contacts=count, samples=samples, generator=generator)
    names = tuple(f"{row:02d}" for row in range(count))
    impacts = Impacts(contacts, sounds, sample_rate, names)
    return impacts, IMPULSE.features(), Extraction(bank, gains + 0j, residual)


def start(
    impacts: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig,
    *,
    spatial_damping: bool = False,
    kind: type[TrainingRun] = TrainingRun,
    device: str = "cpu",
) -> tuple[TrainingRun, Targets]:
    """Return a run before its first step, and what it is to be fitted to."""
    gains = fit_sine_gains(impacts.sounds, modes.bank, sample_rate=impacts.sample_rate)
    config = replace(config, damping="per-contact" if spatial_damping else "shared")
    data = GainData(impacts, features, modes, torch.zeros_like(modes.bank.frequency), gains, config)
    network, rows = Attention().start(data)
    return kind(network, data, device), Targets.of(data, rows, device)


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


def measure(options: Options) -> Report:
    """Return the milliseconds of a step of each chosen part."""
    device = torch.device(options.device)
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} threads"
    figures = {f"{part}_step_ms": PARTS[part](options) for part in options.parts}
    conventions = (
        f"On {options.device} ({card}, torch {torch.__version__}); the mean over many steps after the first ones.",
        "paper: preset `paper` end to end, 8 recordings x 3 s x 48 kHz x 128 modes, all frames at every step.",
        "splat: default settings with 15,000 points on the hull of 48 views of 256 x 256; the last nine tenths of the "
        "steps with all that comes between them, densification too.",
    )
    return Report(conventions, (Table("milliseconds a step", ("part", "ms"), list(figures.items())),), figures)


def _paper(options: Options) -> float:
    run, targets = start(
        *full_setting(0.5 if options.quick_look else 3.0, count=8, sample_rate=48000.0), PAPER, device=options.device
    )
    run.step = PAPER.warmup_steps
    count = 2 if options.quick_look else 100 if run.shift.is_cuda else 8
    times = []
    for _ in range(2):
        # A loss is there when all steps before it are.
        losses = [run.advance(targets) for _ in range(count)]
        times.append((float(losses[-1]), time.perf_counter()))
    return 1e3 * (times[1][1] - times[0][1]) / count


def _splat(options: Options) -> float:
    count, size, steps = (6, 48, 100) if options.quick_look else (48, 256, SplatConfig().steps)
    views = pictures(speckled(shape("bowl"), seed=0), count=count, size=size)
    seen: list[tuple[int, float]] = []

    def note(progress: SplatProgress) -> None:
        seen.append((progress.step, time.perf_counter()))

    splat(views, SplatConfig(steps=steps), device=options.device, progress=note)
    (first, begun), (last, ended) = next(each for each in seen if each[0] >= steps / 10), seen[-1]
    return 1e3 * (ended - begun) / (last - first)


PARTS: dict[str, Callable[[Options], float]] = {"paper": _paper, "splat": _splat}


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
