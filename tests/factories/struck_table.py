"""A table of contacts with many modes, drawn by chance, for the tests of what plays it."""

import math

import torch

from avmsf.export.sampled_field import SampledField
from avmsf.modal.residual_noise import shape_noise

RATE = 16_000.0


def struck_table(*, shared: bool, modes: int = 40, points: int = 6, seconds: float = 3.0) -> SampledField:
    """Return contacts on a ball whose modes ring between some milliseconds and all of the time."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*size: int) -> torch.Tensor:
        return torch.rand(*size, dtype=torch.float64, generator=generator)

    frequency = (60.0 * (0.45 * RATE / 60.0) ** drawn(modes)).sort().values
    damping = 0.5 * 400.0 ** drawn(modes)
    if not shared:
        damping = damping * (0.5 + drawn(points, modes))
    out = torch.nn.functional.normalize(drawn(points, 3) - 0.5, dim=1).float()
    samples = round(seconds * RATE)
    residual = torch.linspace(1e-3, 1e-4, 65)
    draw = shape_noise(residual, contacts=1, samples=samples, generator=generator)[0]
    size = 0.1 / math.sqrt(modes)
    return SampledField(
        0.1 * out,
        out,
        frequency,
        damping,
        torch.complex(size * (drawn(points, modes) - 0.5), 0.3 * size * (drawn(points, modes) - 0.5)).to(
            torch.complex64
        ),
        draw,
        RATE,
        per_newton=True,
        name="ball",
    )
