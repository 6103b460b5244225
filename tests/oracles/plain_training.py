"""A step of training as one would write it at first: one product with a table of atoms, all gradients by autograd."""

import math
from dataclasses import replace

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
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual, shape_noise

from .plate import Plate, plate_surface_points, sample_contacts

STEPS = replace(PAPER, warmup_steps=100, spectral_norm="each", damping="shared")
"""The paper's settings but for a short warm-up, enough for gains of a trained field's size, and relative losses."""
_MODES, _POINTS = 128, 8192


class PlainRun(TrainingRun):
    """The same run with a table of atoms in float32, within its error of the phase."""

    def sounds(self, rows: Int[Tensor, " contacts"]) -> Float[Tensor, "contacts samples"]:
        gains = self.network.read(rows).mean
        times = torch.arange(self.samples, dtype=torch.float32) / self.sample_rate
        frequency, damping = self.bank.frequency.float(), self.bank.damping.float()
        atoms = torch.exp(-damping[:, None] * times) * torch.sin(2 * math.pi * frequency[:, None] * times)
        noise = shape_noise(self.residual.magnitude, contacts=len(rows), samples=self.samples, generator=self.generator)
        return gains @ atoms + noise

    def spectral_loss(self, targets: Targets) -> Float[Tensor, ""]:
        sounds = self.sounds(targets.rows)
        return _distance(sounds, targets.whole) + self.config.early_weight * _distance(sounds, targets.early)


def _distance(sounds: Float[Tensor, "contacts samples"], target: SpectralTarget) -> Float[Tensor, ""]:
    loss, sounds = sounds.new_zeros(()), sounds[:, : target.samples]
    for each in target.resolutions:
        spectra = torch.stft(
            sounds, len(each.window), each.hop, window=each.window, pad_mode="constant", return_complex=True
        )
        loss = loss + (spectra.abs().mT - each.magnitudes).abs().sum() / each.magnitudes.sum()
    return loss


def full_setting(
    seconds: float, *, count: int = 10, sample_rate: float = 44100.0
) -> tuple[Impacts, FeatureField, Extraction]:
    """Return `count` recordings of 128 known modes and noise on a plate, with what is fitted to them; seed 0."""
    generator = torch.Generator().manual_seed(0)
    samples, plate = round(seconds * sample_rate), Plate()
    contacts = sample_contacts(plate, count, generator=generator)
    frequency = 200.0 * 80.0 ** torch.rand(_MODES, generator=generator, dtype=torch.float64).sort().values
    bank = ModalBank(frequency, 5.0 + 1e-3 * frequency)
    gains = torch.randn(count, _MODES, generator=generator)
    residual = Residual(torch.full((513,), 0.03))
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=sample_rate)
    sounds += shape_noise(residual.magnitude, contacts=count, samples=samples, generator=generator)
    names = tuple(f"{row:02d}" for row in range(count))
    features = FeatureField.from_points(plate_surface_points(plate, _POINTS))
    return Impacts(contacts, sounds, sample_rate, names), features, Extraction(bank, gains + 0j, residual)


def start(
    impacts: Impacts,
    features: FeatureField,
    modes: Extraction,
    config: FitConfig,
    *,
    kind: type[TrainingRun] = TrainingRun,
    device: str = "cpu",
) -> tuple[TrainingRun, Targets]:
    """Return a run before its first step, and what it is to be fitted to."""
    gains = fit_sine_gains(impacts.sounds, modes.bank, sample_rate=impacts.sample_rate)
    data = GainData(impacts, features, modes, torch.zeros_like(modes.bank.frequency), gains, config)
    network, rows = Attention().start(data)
    return kind(network, data, device), Targets.of(data, rows, device)
