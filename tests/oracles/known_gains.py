"""Gains of a body whose modes are known, at contacts with the errors of a careful hand."""

from functools import partial

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.features.feature_field import FeatureField
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.field.config import FitConfig
from avmsf.field.gains.data import GainData
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual


def known_gains(true: ElasticModes) -> tuple[GainData, Float64[Tensor, "others 3"], Float64[Tensor, "others 3"]]:
    """Return gains at 12 contacts with errors of place, direction and force, and 200 other contacts with directions."""
    generator = torch.Generator().manual_seed(0)
    drawn = partial(torch.randn, generator=generator, dtype=torch.float64)
    points = true.nodes[torch.randperm(len(true.nodes), generator=generator)[:212]]
    ways = -true.normals(points)
    known, others = points[:12], points[12:]
    struck = ways[:12] + 0.05 * drawn(12, 3)
    gains = true.gains(known + 0.0015 * drawn(12, 3) / 3**0.5, struck / struck.norm(dim=1, keepdim=True))
    gains = gains * (1 + 0.02 * drawn(12, 1))
    impacts = Impacts(
        contacts=known.float(), sounds=torch.zeros(12, 4410), sample_rate=44100.0,
        names=tuple(f"{row:03d}" for row in range(12)), directions=ways[:12].float(),
    )  # fmt: skip
    bank = ModalBank(true.frequency, torch.full_like(true.frequency, 20.0))
    found = Extraction(bank, gains + 0j, Residual(torch.zeros(1025)))
    phase = torch.zeros(len(true), dtype=torch.float64)
    features = FeatureField.from_points(true.nodes.float())
    return GainData(impacts, features, found, phase, gains, FitConfig()), others, ways[12:]
