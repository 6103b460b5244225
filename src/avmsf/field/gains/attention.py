"""How strongly an impact at a place excites each mode: the paper's attention network (section 3.5)."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avmsf._utils.text import RecordError, count_of, like, record_of
from avmsf.features.feature_field import FeatureField, Regions
from avmsf.field.config import AttentionShape
from avmsf.field.gains.model import GainModel, Gains
from avmsf.field.training import TrainableGains

_MAX_LAYERS = 64
"""Hidden layers, or bands of frequency, of a network in a file: thirty times those of the paper's. Each takes time
to build before it can be compared with the file's tensors."""
_EXAMPLE = AttentionShape(clusters=1, bands=0, width=1, hidden=1, layers=0, feature_scale=1.0)


class AttentionGains(TrainableGains, GainModel):
    """Gains from a contact's own feature and from attention over the object's regions (paper, eqs. 7-11).

    Holds the points it looks contacts up in, so that a saved network needs nothing else.
    """

    kind: ClassVar[str] = "attention"
    points: Float[Tensor, "points 3"]
    features: Float[Tensor, "points dim"]
    centers: Float[Tensor, "clusters 3"]
    descriptors: Float[Tensor, "clusters dim"]
    gain_scale: Float[Tensor, " modes"]

    def __init__(
        self,
        features: FeatureField,
        *,
        gain_scale: Float[Tensor, " modes"],
        shape: AttentionShape,
        generator: torch.Generator,
        regions: Regions | None = None,
    ) -> None:
        """Build an untrained network whose gains are about `gain_scale` in size, mode by mode, in float32.

        `regions` are the features' clusters where they have been found before.
        """
        super().__init__()
        regions = features.clusters(shape.clusters) if regions is None else regions
        self.shape, self.encoder = shape, features.encoder
        self.register_buffer("points", features.points.float())
        self.register_buffer("features", features.features.float())
        self.register_buffer("centers", regions.centers.float())
        self.register_buffer("descriptors", regions.descriptors.float())
        self.register_buffer("gain_scale", gain_scale.float())
        # Layers draw from torch's global generator as they are made, which is not ours to advance.
        with torch.random.fork_rng(devices=[]):
            self._build(features.features.shape[1], len(gain_scale))
        self._initialize(generator)

    def _build(self, dim: int, modes: int) -> None:
        shape = self.shape
        encoded = shape.clusters * 3 * (1 + 2 * shape.bands)
        self.query = nn.Linear(encoded + dim, shape.width, bias=False)
        self.key = nn.Linear(dim, shape.width, bias=False)
        self.value = nn.Linear(dim, shape.width, bias=False)
        self.project = nn.Linear(shape.width, shape.width, bias=False) if shape.projection else nn.Identity()
        sizes = [shape.width + dim] + [shape.hidden] * shape.layers
        stack: list[nn.Module] = []
        for before, after in pairwise(sizes):
            stack += [nn.Linear(before, after), nn.SiLU()]
        self.head = nn.Sequential(*stack)
        self.to_gains = nn.Linear(sizes[-1], modes)
        self.to_dampings = nn.Linear(sizes[-1], modes) if shape.spatial_damping else None

    def _initialize(self, generator: torch.Generator) -> None:
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                bound = 1 / math.sqrt(layer.in_features)
                with torch.no_grad():
                    layer.weight.uniform_(-bound, bound, generator=generator)
                    if layer.bias is not None:
                        layer.bias.zero_()
        if self.to_dampings is not None:
            nn.init.zeros_(self.to_dampings.weight)

    @property
    def feature_field(self) -> FeatureField:
        """The points and features that the network reads."""
        return FeatureField(self.points, self.features, self.encoder)

    def reorder(self, modes: Int[Tensor, " modes"]) -> None:
        """Put the outputs for the modes in the given order, in place."""
        with torch.no_grad():
            self.gain_scale.copy_(self.gain_scale[modes])
            for layer in (self.to_gains, self.to_dampings):
                if layer is not None:
                    layer.weight.copy_(layer.weight[modes])
                    layer.bias.copy_(layer.bias[modes])

    def predict(
        self, points: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Gains:
        """Return the gains at the contacts, for any direction, and the factors where dampings vary."""
        return self.read(self.feature_field.nearest(points))

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return what `predict` does for the points of the given rows; differentiable in the network's parameters."""
        feature = self.features[rows] * self.shape.feature_scale
        # The object's size as a tensor, since a number of it would wait for the device.
        half_diagonal = torch.dist(*self.points.aminmax(dim=0)) / 2
        offsets = (self.points[rows][:, None, :] - self.centers) / half_diagonal
        query = self.query(torch.cat([encode(offsets, self.shape.bands).flatten(1), feature], dim=1))
        descriptors = self.descriptors * self.shape.feature_scale
        key, value = self.key(descriptors), self.value(descriptors)
        attention = torch.softmax(query @ key.T / math.sqrt(self.shape.width), dim=1)
        hidden = self.head(torch.cat([self.project(attention @ value), feature], dim=1))
        factors = None if self.to_dampings is None else torch.exp(self.to_dampings(hidden))
        return Gains(self.to_gains(hidden) * self.gain_scale, damping=factors)

    def finished(self, order: Int[Tensor, " modes"]) -> "AttentionGains":
        """Return the network with its modes in the given order, ready for use."""
        self.reorder(order)
        return self.eval().requires_grad_(False)

    def record(self) -> dict[str, Any]:
        """Return the sizes and who made the features."""
        return {
            "points": self.points.shape[0],
            "dim": self.features.shape[1],
            "modes": self.gain_scale.shape[0],
            "encoder": self.encoder,
            "shape": asdict(self.shape),
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the points, the features and the weights."""
        return dict(self.state_dict())

    @classmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors like those of a network of these sizes, which take no memory."""
        return dict(cls._empty(record).state_dict())

    @classmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "AttentionGains":
        """Return the network, ready for use."""
        network = cls._empty(record)
        network.load_state_dict(dict(tensors), assign=True)
        return network.eval().requires_grad_(False)

    @classmethod
    def _empty(cls, record: Mapping[str, Any]) -> "AttentionGains":
        points, dim, modes = (count_of(record[name], name) for name in ("points", "dim", "modes"))
        encoder = like(record["encoder"], "", "encoder")
        shape = record_of(_EXAMPLE, record["shape"], "shape")
        if shape.layers > _MAX_LAYERS or shape.bands > _MAX_LAYERS:
            most = max(shape.layers, shape.bands)
            raise RecordError(f"layers, bands: expected at most {_MAX_LAYERS}, got {most}", name="layers", value=most)
        with torch.device("meta"):
            return cls(
                FeatureField(torch.empty(points, 3), torch.empty(points, dim), encoder),
                gain_scale=torch.empty(modes),
                shape=shape,
                generator=torch.Generator(device="cpu"),
                regions=Regions(torch.empty(shape.clusters, 3), torch.empty(shape.clusters, dim)),
            )


def encode(offsets: Float[Tensor, "*shape 3"], bands: int) -> Float[Tensor, "*shape encoded"]:
    """Return the offsets with sines and cosines of pi, 2 pi, 4 pi, ... times them (NeRF's encoding; paper: PE)."""
    angles = offsets[..., None] * (math.pi * 2.0 ** torch.arange(bands, dtype=offsets.dtype, device=offsets.device))
    waves = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)
    return torch.cat([offsets, waves.flatten(-2)], dim=-1)
