"""The visual family: places that look alike sound alike, wherever they are or only where they are near, too."""

from typing import ClassVar

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avmsf.field.gains.family import KernelFamily, Sites, scaled, squared_exponential
from avmsf.scene.points import nearest_points

LOOKS = (0.25, 0.5, 1.0)
"""Lengths in feature space, over the root mean square distance between the features of points."""
LENGTHS = (0.2, 0.4, 0.8)
"""Lengths of the positions' kernels over the object's size, which multiply those of the features."""


class Visual(KernelFamily):
    """Squared exponential kernels in the distance between features, by themselves and times those of positions.

    An impact has the features of the nearest point of the object.
    """

    kind: ClassVar[str] = "visual"

    def __init__(
        self,
        reference: Sites,
        size: float,
        points: Float32[Tensor, "points 3"],
        features: Float32[Tensor, "points dim"],
    ) -> None:
        """Set up from an object's points, metres, and their features, in any unit."""
        super().__init__(reference, size)
        self.points, self.features = points, features
        spread = features.double().var(0, correction=0).sum()
        self._unit = float((2.0 * spread).sqrt()) or 1.0
        self._looks = torch.tensor(LOOKS, dtype=torch.float64)
        self._lengths = size * torch.tensor(LENGTHS, dtype=torch.float64)
        shares = torch.eye(len(LOOKS) * (1 + len(LENGTHS)), dtype=torch.float64)
        self.shares = scaled(shares, self.diagonal(reference))

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the features' kernels, then their products with each of the positions'."""
        alike = squared_exponential(self._looks_at(sites), self._looks_at(others), self._looks) * sites.cosine(others)
        near = squared_exponential(sites.points, others.points, self._lengths)
        return torch.cat([alike, (near[:, None] * alike).flatten(0, 1)])

    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return ones."""
        return torch.ones(len(LOOKS) * (1 + len(LENGTHS)), len(sites), dtype=torch.float64)

    def _looks_at(self, sites: Sites) -> Float64[Tensor, "sites dim"]:
        return self.features[nearest_points(self.points, sites.points)[:, 0]].double() / self._unit
