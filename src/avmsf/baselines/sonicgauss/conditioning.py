"""What SonicGauss knows of an object and a contact: Gaussians in 23 channels, the encoded contact, and their fusion.

Modules have the published names of their tensors.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avmsf.errors import EvaluationError
from avmsf.gaussians.cloud import GaussianCloud

CHANNELS = 23
LEAST_LOGIT = 0.02
"""Opacity, before the sigmoid, below which the published program leaves a Gaussian out."""
FREQUENCIES = 10


@dataclass(frozen=True, eq=False)
class Normalized:
    """An object's Gaussians in the unit cube."""

    centers: Float[Tensor, "points 3"]
    """0 to 1; the box's longest side is 1, its middle .5."""
    features: Float[Tensor, "points 23"]
    """Center, log scale, opacity logit, quaternion, harmonics of degree 0, nine coefficients above."""
    scale: float
    """Unit cubes per meter."""
    shift: Float[Tensor, "3"]

    def places(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Return points of the object frame, meters, in the unit cube."""
        return points.to(self.shift) * self.scale + self.shift


def normalized(cloud: GaussianCloud, rest: Float[Tensor, "points 9"]) -> Normalized:
    """Return the Gaussians that are not faint, with these coefficients above degree 0.

    Raises EvaluationError where none is left, or all are in one place.
    """
    kept = cloud.logit_opacities >= LEAST_LOGIT
    if not bool(kept.any()):
        got, advice = f"{len(cloud)} of lower opacity", "fit them with more steps"
        raise EvaluationError.expected("Gaussians above .5", len(cloud), got=got, name="opacity", advice=advice)
    chosen, rest = cloud.detach().take(kept), rest.detach()[kept]
    low, high = chosen.centers.amin(0), chosen.centers.amax(0)
    extent = float((high - low).max())
    if not extent > 0.0:
        wanted, got = "Gaussians over the whole object", f"{len(chosen)} at one position"
        raise EvaluationError.expected(wanted, len(chosen), got=got, name="centers", advice="fit them again")
    shift = 0.5 - 0.5 * (low + high) / extent
    centers = chosen.centers / extent + shift
    parts = [
        centers,
        chosen.log_scales - math.log(extent),
        chosen.logit_opacities[:, None],
        chosen.rotations,
        chosen.harmonics[:, 0],
        rest,
    ]
    return Normalized(centers, torch.cat(parts, dim=1).float(), 1.0 / extent, shift)


def first_nine(cloud: GaussianCloud) -> Float[Tensor, "points 9"]:
    """Return what the published program takes for degree 1: the first nine of a file's 45 coefficients, all of red.

    Clouds of a lower degree are continued by zeros to degree 3. The published weights were trained on this.
    """
    rest = cloud.harmonics[:, 1:]
    padded = torch.nn.functional.pad(rest, (0, 0, 0, 15 - rest.shape[1]))
    return padded.mT.flatten(1)[:, :9]


class ContactEncoding(nn.Module):
    """Sines and cosines of a contact at ten frequencies 2^k pi, and the contact itself, through a perceptron."""

    freqs: Tensor

    def __init__(self, hidden: Sequence[int] = (256, 512), width: int = 1024) -> None:
        super().__init__()
        sizes = [3 + 3 * 2 * FREQUENCIES, *hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(sizes):
            layers += [nn.Linear(before, after), nn.ReLU()]
        self.mlp = nn.Sequential(*layers, nn.Linear(sizes[-1], width))
        self.register_buffer("freqs", 2.0 ** torch.arange(FREQUENCIES))

    def forward(self, places: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts width"]:
        """Return the encoded contacts, places in the unit cube."""
        angles = places[:, :, None] * self.freqs * math.pi
        waves = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
        encoded: Tensor = self.mlp(torch.cat([waves, places], dim=1))
        return encoded


class Fusion(nn.Module):
    """Tokens of an object and of a contact: the object's own, then those that attend to the contact.

    As published there is one contact token to attend to, so that attention adds the same vector to all tokens.
    """

    def __init__(self, width: int = 1024, heads: int = 8, dropout: float = 0.1) -> None:
        super().__init__()
        self.cross_attn = nn.MultiheadAttention(width, heads, dropout=dropout, batch_first=True)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.ffn = nn.Sequential(
            nn.Linear(width, 4 * width),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(4 * width, width),
            nn.Dropout(dropout),
        )

    def forward(
        self, tokens: Float[Tensor, "batch tokens width"], contact: Float[Tensor, "batch width"]
    ) -> Float[Tensor, "batch both width"]:
        """Return twice as many tokens."""
        place = contact[:, None]
        attended = tokens + self.cross_attn(self.norm1(tokens), place, place, need_weights=False)[0]
        return torch.cat([tokens, attended + self.ffn(self.norm2(attended))], dim=1)
