"""Makes the field files of `tests/field/data/format-N`, which all later versions have to read.

In `tests`, `python -m factories.stored_fields field/data/format-N` writes one field of each kind, and what they
render. Once a format is released its files are not made again.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from safetensors.torch import save_file

from avmsf.capture import Impacts
from avmsf.features.feature_field import FeatureField
from avmsf.field.gains.attention import AttentionGains, AttentionShape
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import Sites, Smooth, ThinPlate, Unstructured, Visual
from avmsf.field.gains.model import GainModel
from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.extraction.alignment import align
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.symmetry.characters import Group
from factories.made_modes import breathing_sphere

RADIUS = 0.05  # meters
RATE, SAMPLES = 8000.0, 800
BANK = ModalBank(
    torch.tensor([390.0, 850.0, 1300.0], dtype=torch.float64), torch.tensor([12.0, 15.0, 30.0], dtype=torch.float64)
)
GENERATOR = torch.Generator().manual_seed(0)


def on_sphere(count: int) -> torch.Tensor:
    drawn = torch.randn(count, 3, dtype=torch.float64, generator=GENERATOR)
    return RADIUS * drawn / drawn.norm(dim=1, keepdim=True)


POINTS = on_sphere(60).float()
CONTACTS = on_sphere(8)
ASKED = on_sphere(4)


def mixture() -> GainModel:
    """Return a model of all families."""
    sites, size = Sites(CONTACTS, -CONTACTS / RADIUS), 2 * RADIUS
    looks = torch.randn(len(POINTS), 4, generator=GENERATOR)
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    motions = torch.stack([torch.eye(3, dtype=torch.float64), turn])
    motions = torch.cat([motions, torch.zeros(2, 3, 1, dtype=torch.float64)], dim=2)
    half_turn = Group(motions, torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.float64))
    families = [
        *(each(sites, size) for each in (Unstructured, Smooth, ThinPlate)),
        Symmetric(sites, size, [half_turn], directional=True),
        Visual(sites, size, POINTS, looks),
        Elastic(sites, size, breathing_sphere(RADIUS, 400.0, detail=1)),
    ]
    waves = torch.stack([1 + 0.1 * CONTACTS[:, 0], CONTACTS[:, 0] / RADIUS, CONTACTS[:, 1] / RADIUS], dim=1)
    measured = MeasuredGains(waves * (1 + 0.2j), torch.full((3,), 1e-4).double(), BANK.frequency, BANK.damping)
    return fit_mixture(families, measured, POINTS, directional=True)


def attention() -> GainModel:
    return (
        AttentionGains(
            FeatureField.from_points(POINTS),
            gain_scale=torch.tensor([2.0, 1.0, 0.5]),
            shape=AttentionShape(4, 2, 8, 8, 2, feature_scale=4.0, spatial_damping=True, projection=True),
            generator=GENERATOR,
        )
        .eval()
        .requires_grad_(False)
    )


def fields() -> dict[str, SoundField]:
    """Return a field of each kind, with all that a file may hold."""
    times = torch.arange(SAMPLES) / RATE
    waves = torch.exp(-BANK.damping[:, None] * times) * torch.sin(2 * torch.pi * BANK.frequency[:, None] * times)
    gains = torch.randn(len(CONTACTS), 3, generator=GENERATOR)
    sounds = (gains.double() @ waves).float() + 1e-3 * torch.randn(len(CONTACTS), SAMPLES, generator=GENERATOR)
    names = tuple(f"{row:03d}.wav" for row in range(len(CONTACTS)))
    aligned = align(Impacts(CONTACTS, sounds, RATE, names))
    noise = torch.linspace(1e-3, 1e-4, 9)
    sphere = breathing_sphere(RADIUS, 400.0, detail=1)
    modes = replace(sphere, frequency=BANK.frequency, shapes=sphere.shapes.repeat(1, 3, 1).float().double())
    made: dict[str, GainModel] = {"mixture": mixture(), "attention": attention(), "body": BodyGains(POINTS, modes)}
    made["scaled"] = ScaledGains(made["mixture"], torch.tensor([2.0, -0.5, 0.0], dtype=torch.float64), 1.5)
    phase, origin = torch.tensor([0.0, 0.4, -1.2], dtype=torch.float64), Origin("sphere", names)
    whole = {
        kind: SoundField(BANK, gains, phase, Residual(noise), RATE, SAMPLES, origin) for kind, gains in made.items()
    }
    remains = Residual(noise, 1e-3 * torch.randn(len(CONTACTS), SAMPLES, generator=GENERATOR))
    return whole | {"mixture": replace(whole["mixture"], residual=remains, alignment=aligned)}


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    expected = {"positions": ASKED}
    for kind, field in fields().items():
        field.save(folder / f"{kind}.safetensors")
        expected[kind] = field.render(ASKED, samples=200)
    save_file(expected, folder / "expected")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
