"""A plate whose mode shapes are products of cosines: impacts, gain models of them, a gain field of every kind."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors.torch import load as from_bytes
from safetensors.torch import save as to_bytes

from avmsf.features.feature_field import FeatureField
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.field.config import AttentionShape
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import KernelFamily, Sites, Smooth, ThinPlate, Unstructured
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import GainModel
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual

from .made_modes import sliding_plate


class StandIn(GainModel):
    """Gains of a formula, which no file brings back."""

    kind: ClassVar[str] = "formula"
    restore = None  # type: ignore[assignment]

    def record(self) -> dict[str, Any]:
        return {}

    def tensors(self) -> dict[str, torch.Tensor]:
        return {name: each for name, each in vars(self).items() if isinstance(each, torch.Tensor)}


SIDES = (0.24, 0.17, 0.004)
SIZE = float(torch.tensor(SIDES, dtype=torch.float64).norm())
POSITIONAL = (Unstructured, Smooth, ThinPlate)


@cache
def plate() -> ElasticModes:
    return sliding_plate()


def draw(*size: int, seed: int) -> torch.Tensor:
    return torch.rand(*size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.5


def places(count: int, *, seed: int) -> torch.Tensor:
    """Return places on both of the plate's large faces."""
    drawn = draw(count, 3, seed=seed) * torch.tensor(SIDES, dtype=torch.float64)
    drawn[:, 2] = torch.where(drawn[:, 2] < 0, -0.5, 0.5) * SIDES[2]
    # Such that float32 holds them exactly.
    return drawn.float().double()


def blows(contacts: torch.Tensor, *, seed: int, askew: float = 0.5) -> torch.Tensor:
    """Return unit vectors into the plate, up to some thirty degrees askew."""
    directions = 2.0 * askew * draw(len(contacts), 3, seed=seed)
    directions[:, 2] = -contacts[:, 2].sign()
    return directions / directions.norm(dim=1, keepdim=True)


def impacts(count: int, *, seed: int, askew: float = 0.5) -> Sites:
    points = places(count, seed=seed)
    return Sites(points, blows(points, seed=seed + 1000, askew=askew))


def families(sites: Sites, *, elastic: bool = True) -> list[KernelFamily]:
    found: list[KernelFamily] = [kind(sites, SIZE) for kind in POSITIONAL]
    return [*found, Elastic(sites, SIZE, plate())] if elastic else found


def measured(sites: Sites, *, noise: float = 0.02, factor: float = 1.0) -> MeasuredGains:
    """Return gains of the plate's first five modes, the imaginary parts a third of the real ones, and noise."""
    shapes = plate().gains(sites.points, sites.directions)[:, :5] * torch.linspace(2.0, 0.5, 5, dtype=torch.float64)
    parts = torch.stack([shapes, shapes / 3.0], dim=2)
    parts = parts + noise * shapes.std() * (12.0**0.5) * draw(*parts.shape, seed=3)
    damping = torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64)
    variance = torch.full((5,), 1e-5, dtype=torch.float64)
    return MeasuredGains(torch.view_as_complex(parts), variance, factor * plate().frequency[:5], damping)


@cache
def model(*, elastic: bool = True) -> MixtureGains:
    """Return the model of some impacts, two of them at one place; the second mode is affine, the last one noise."""
    sites = impacts(14, seed=1).take(torch.tensor([*range(13), 0]))
    gains, points = measured(sites), impacts(50, seed=9).points.float()
    gains.values[:, 1] += sites.directions[:, 2] * (1.0 + sites.points @ (40.0 * draw(3, seed=6))) * (300.0 - 100.0j)
    gains.values[:, 4] = torch.view_as_complex(draw(14, 2, seed=7))
    return fit_mixture(families(sites, elastic=elastic), gains, points, directional=True)


BANK = ModalBank(
    torch.tensor([390.0, 850.0, 1300.0, 1360.0, 2300.0], dtype=torch.float64),
    torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64),
)
"""Measured modes, each a little off one of the plate's elastic ones."""


def struck(count: int, *, noise: float = 0.05) -> tuple[Sites, torch.Tensor]:
    """Return impacts and their complex gains, which are nearly those of the plate's first modes."""
    contacts = places(count, seed=1)
    directions = blows(contacts, seed=2)
    shapes = plate().gains(contacts, directions)[:, : len(BANK)]
    parts = torch.stack([shapes, 0.3 * shapes.roll(1, dims=1)], dim=2) * torch.linspace(2.0, 0.5, len(BANK))[:, None]
    parts += noise * parts.std() * draw(*parts.shape, seed=3)
    return Sites(contacts, directions), torch.view_as_complex(parts)


def attention(*, spatial_damping: bool = False) -> AttentionGains:
    shape = AttentionShape(6, 2, 8, 12, 2, feature_scale=4.0, spatial_damping=spatial_damping)
    points, generator = FeatureField.from_points(places(150, seed=0)), torch.Generator().manual_seed(0)
    scale = torch.tensor([2.0, 1.0, 0.5, 1.5, 0.1])
    network = AttentionGains(points, gain_scale=scale, shape=shape, generator=generator)
    return with_biases(network).eval().requires_grad_(False)


def with_biases(network: AttentionGains) -> AttentionGains:
    """Draw what starts at zero, biases and the logarithms of damping factors, so that a test sees it."""
    with torch.no_grad():
        for number, parameter in enumerate(network.parameters()):
            if parameter.ndim == 1 or not bool(parameter.any()):
                parameter.normal_(std=0.1, generator=torch.Generator().manual_seed(number))
    return network


def mixture(
    sites: Sites,
    values: torch.Tensor,
    *more: KernelFamily,
    directional: bool,
    positional: Sequence[type[KernelFamily]] = POSITIONAL,
    bank: ModalBank = BANK,
    points: torch.Tensor | None = None,
    size: float = SIZE,
    variance: float = 1e-4,
) -> MixtureGains:
    """Return a model of the positional families and some more: of this plate's gains, or of another object's."""
    measured = MeasuredGains(values, torch.full_like(bank.damping, variance), bank.frequency, bank.damping)
    points = places(150, seed=0) if points is None else points
    return fit_mixture(
        [*(kind(sites, size) for kind in positional), *more], measured, points.float(), directional=directional
    )


def positional(count: int = 20, *, noise: float = 0.05) -> MixtureGains:
    """Return a model that knows no directions: all impacts are as from one side."""
    impacts, values = struck(count, noise=noise)
    alike = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(count, 3)
    side = -impacts.directions[:, 2:].sign()
    return mixture(Sites(impacts.points, alike), side * values, directional=False)


def directional() -> MixtureGains:
    """Return a model that knows directions, and no body."""
    return mixture(*struck(20), directional=True)


def elastic() -> MixtureGains:
    """Return a model with the plate's own mode shapes, fitted to gains a little off the measured ones."""
    impacts, values = struck(9)
    body = Elastic(impacts, SIZE, plate())
    return replace(mixture(impacts, 1.1 * values, body, directional=True), measured=values)


def body() -> BodyGains:
    """Return what the plate's own modes alone say."""
    known, count = plate(), len(BANK)
    modes = replace(known, frequency=known.frequency[:count], shapes=known.shapes[:, :count].float().double())
    return BodyGains(places(150, seed=0).float(), modes)


FIELDS: dict[str, Callable[[], GainModel]] = {
    "attention": cache(attention),
    "attention with dampings": cache(lambda: attention(spatial_damping=True)),
    "positional": cache(positional),
    "positional, noisy": cache(lambda: positional(30, noise=3.0)),
    "positional, few contacts": cache(lambda: positional(4)),
    "directional": cache(directional),
    "elastic": cache(elastic),
    "body": cache(body),
}
"""All there are, by what tests call them; the same object at every call."""


def sounding(
    gains: GainModel,
    *,
    bank: ModalBank = BANK,
    phase: torch.Tensor | float = 0.0,
    noise: float = 0.01,
    rate: float = 8000.0,
    samples: int = 2000,
    origin: Origin | None = None,
) -> SoundField:
    """Return a field of the plate's modes, or of others, with white noise."""
    phases = torch.as_tensor(phase, dtype=torch.float64).expand(len(bank)).clone()
    return SoundField(bank, gains, phases, Residual(torch.full((9,), noise)), rate, samples, origin or Origin("plate"))


def record_in(path: Path) -> dict[str, Any]:
    """Return the record in the header of a field's file."""
    content = path.read_bytes()
    return json.loads(json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]["avmsf"])


Change = Callable[[dict[str, torch.Tensor], dict[str, Any]], None]


def rewritten(path: Path, change: Change) -> Path:
    """Write a field's file once more beside it, as changed.safetensors, with its tensors and record changed."""
    tensors, record = from_bytes(path.read_bytes()), record_in(path)
    change(tensors, record)
    changed = path.with_name("changed.safetensors")
    changed.write_bytes(to_bytes(tensors, {"avmsf": json.dumps(record)}))
    return changed


def saved(gains: GainModel, folder: Path) -> Path:
    """Write the field of these gains, and return its path."""
    save(sounding(gains), folder / "plate.safetensors")
    return folder / "plate.safetensors"
