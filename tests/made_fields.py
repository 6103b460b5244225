"""One gain field of every kind, for a plate whose shapes are known in closed form, made in a moment."""

from collections.abc import Callable
from functools import cache

import torch

from avmsf.field.attention import AttentionGains, AttentionShape
from avmsf.field.elasticpoints import ElasticPoints
from avmsf.field.gainfield import GainField
from avmsf.field.modalbasis import ModalBasis, fit_modal_basis
from avmsf.field.thinplategains import ThinPlateGains, thin_plate_gains
from avmsf.modal.bank import ModalBank
from avmsf.scene.features import FeatureField
from avmsf.simulate.elastic import ElasticModes
from made_modes import sliding_plate

SIDES = (0.24, 0.17, 0.004)
BANK = ModalBank(
    torch.tensor([390.0, 850.0, 1300.0, 1360.0, 2300.0], dtype=torch.float64),
    torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64),
)
"""Measured modes, each a little off one of the plate's elastic ones."""


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


def blows(contacts: torch.Tensor, *, seed: int) -> torch.Tensor:
    """Return unit vectors into the plate, up to some thirty degrees askew."""
    askew = draw(len(contacts), 3, seed=seed)
    askew[:, 2] = -contacts[:, 2].sign()
    return askew / askew.norm(dim=1, keepdim=True)


def struck(count: int, *, noise: float = 0.05) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return contacts, directions, and gains that are nearly those of the plate's first modes, in two parts."""
    contacts = places(count, seed=1)
    directions = blows(contacts, seed=2)
    shapes = plate().gains(contacts, directions)[:, : len(BANK)]
    parts = torch.stack([shapes, 0.3 * shapes.roll(1, dims=1)], dim=2) * torch.linspace(2.0, 0.5, len(BANK))[:, None]
    return contacts, directions, parts + noise * parts.std() * draw(*parts.shape, seed=3)


def attention(*, spatial_damping: bool = False) -> AttentionGains:
    shape = AttentionShape(6, 2, 8, 12, 2, feature_scale=4.0, spatial_damping=spatial_damping)
    network = AttentionGains(
        FeatureField.from_points(places(150, seed=0)),
        gain_scale=torch.tensor([2.0, 1.0, 0.5, 1.5, 0.1]),
        shape=shape,
        generator=torch.Generator().manual_seed(0),
    )
    with torch.no_grad():
        # Biases start at zero and damping factors at one; a test has to see them.
        for number, parameter in enumerate(network.parameters()):
            if parameter.ndim == 1 or not bool(parameter.any()):
                parameter.normal_(std=0.1, generator=torch.Generator().manual_seed(number))
    return network.eval().requires_grad_(False)


def spline(count: int = 20, *, noise: float = 0.05) -> ThinPlateGains:
    contacts, directions, values = struck(count, noise=noise)
    side = -directions[:, 2].sign()
    return thin_plate_gains(
        contacts, values * side[:, None, None], importance=1 / BANK.damping, points=places(150, seed=0)
    )


def physics(count: int = 9) -> ModalBasis:
    contacts, directions, values = struck(count)
    doubt = torch.ones(count, dtype=torch.float64)
    doubt[4] = 10.0
    return fit_modal_basis(
        ElasticPoints.of(plate(), places(150, seed=0)),
        plate().frequency,
        contacts,
        directions,
        values,
        frequency=BANK.frequency,
        floor=torch.full((count, len(BANK)), 1e-4, dtype=torch.float64),
        doubt=doubt,
    )


LINEAR: dict[str, Callable[[], ThinPlateGains | ModalBasis]] = {
    "spline": cache(spline),
    "smoothed spline": cache(lambda: spline(30, noise=3.0)),
    "spline of few": cache(lambda: spline(4)),
    "physics": cache(physics),
}
"""Fields whose mean gains are weighted sums of those at the contacts."""
FIELDS: dict[str, Callable[[], GainField]] = {
    "attention": cache(attention),
    "attention with dampings": cache(lambda: attention(spatial_damping=True)),
    **LINEAR,
}
"""All there are, by what tests call them; the same object at every call."""
