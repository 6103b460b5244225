"""The paper's attention network (section 3.5): gains from image features, and the choice of its dampings."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import softplus

from avmsf._utils.tensor_files import TensorReader
from avmsf._utils.text import RecordError, count_of, like, record_of, without_defaults
from avmsf.capture.impacts import rows_by_place
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import ADDED_SETTINGS, NETWORK, AttentionShape
from avmsf.field.gains.data import GainData
from avmsf.field.gains.model import Directions, GainModel, Gains, Points
from avmsf.field.training import FittedGains, GainEstimator, TrainableGains, Trainer
from avmsf.mesh.points import farthest_points

SHARED, PER_CONTACT = "shared", "per-contact"
"""Dampings that are the same everywhere, and those that vary with the contact."""
_MIN_PLACES = 6
"""Positions below which none are held out to validate on."""
_BATCH = 2048
"""Contacts at once: the encoding of their offsets to many clusters is large."""
_MAX_LAYERS = 64
"""Hidden layers, or bands of frequency, of a network in a file: thirty times those of the paper's. Each takes time
to build before it can be compared with the file's tensors."""


class AttentionGains(TrainableGains, GainModel):
    """Gains from a contact's own feature and from attention over the object's regions (paper, eqs. 7-11).

    Holds the points it looks contacts up in, so that a saved network needs nothing else.
    """

    kind: ClassVar[str] = "attention"

    def __init__(
        self,
        features: FeatureField,
        *,
        gain_scale: Float[Tensor, " modes"],
        shape: AttentionShape,
        generator: torch.Generator,
        regions: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        """Build an untrained network whose gains are about `gain_scale` in size, mode by mode, in float32.

        `regions` are the centers and descriptors of the features' clusters where they have been found before.
        """
        super().__init__()
        centers, descriptors = features.clusters(shape.clusters) if regions is None else regions
        self.shape, self.encoder = shape, features.encoder
        self.points, self.features = nn.Buffer(features.points.float()), nn.Buffer(features.features.float())
        self.centers, self.descriptors = nn.Buffer(centers.float()), nn.Buffer(descriptors.float())
        self.gain_scale = nn.Buffer(gain_scale.float())
        dim, modes = features.features.shape[1], len(gain_scale)
        sizes = [shape.width + dim] + [shape.hidden] * shape.layers
        # Layers draw from torch's global generator as they are made, which is not ours to advance.
        with torch.random.fork_rng(devices=[]):
            self.query = nn.Linear(shape.clusters * 3 * (1 + 2 * shape.bands) + dim, shape.width, bias=False)
            self.key = nn.Linear(dim, shape.width, bias=False)
            self.value = nn.Linear(dim, shape.width, bias=False)
            self.project = nn.Linear(shape.width, shape.width, bias=False) if shape.projection else nn.Identity()
            layers = [each for before, after in pairwise(sizes) for each in (nn.Linear(before, after), nn.SiLU())]
            self.head = nn.Sequential(*layers)
            self.to_gains = nn.Linear(sizes[-1], modes)
            self.to_dampings = nn.Linear(sizes[-1], modes) if shape.spatial_damping else None
        # Files hold float32, whatever the program's default type is.
        self.float()
        with torch.no_grad():
            for layer in self.modules():
                if isinstance(layer, nn.Linear):
                    bound = 1 / math.sqrt(layer.in_features)
                    layer.weight.uniform_(-bound, bound, generator=generator)
                    if layer.bias is not None:
                        layer.bias.zero_()
            if self.to_dampings is not None:
                self.to_dampings.weight.zero_()

    @property
    def feature_field(self) -> FeatureField:
        """The points and features that the network reads."""
        return FeatureField(self.points, self.features, self.encoder)

    def predict(self, points: Points, directions: Directions = None) -> Gains:
        """Return the gains at the contacts, for any direction, and the factors where dampings vary."""
        known = [self.read(rows) for rows in torch.split(self.feature_field.nearest(points), _BATCH)]
        factors = [each.damping for each in known if each.damping is not None]
        return Gains(torch.cat([each.mean for each in known]), damping=torch.cat(factors) if factors else None)

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
        gains = self.to_gains(hidden)
        if self.shape.positive:
            gains = softplus(gains)
        return Gains(gains * self.gain_scale, damping=factors)

    def finished(self, order: Int[Tensor, " modes"]) -> "AttentionGains":
        """Put the network's modes in the given order and return it, ready for use."""
        self.eval().requires_grad_(False)
        self.gain_scale.copy_(self.gain_scale[order])
        for layer in (self.to_gains, self.to_dampings):
            if layer is not None:
                layer.weight.copy_(layer.weight[order])
                layer.bias.copy_(layer.bias[order])
        return self

    def record(self) -> dict[str, Any]:
        """Return the sizes and who made the features."""
        return {
            "points": self.points.shape[0],
            "dim": self.features.shape[1],
            "modes": self.gain_scale.shape[0],
            "encoder": self.encoder,
            "shape": without_defaults(asdict(self.shape), ADDED_SETTINGS),
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the points, the features and the weights."""
        return dict(self.state_dict())

    @classmethod
    def restore(cls, record: Mapping[str, Any], read: TensorReader) -> "AttentionGains":
        """Return the network, ready for use."""
        network = cls._empty(record)
        wanted = sorted(network.state_dict().items())
        tensors = {name: read(name, *each.shape, dtype=each.dtype) for name, each in wanted}
        network.load_state_dict(tensors, assign=True)
        return network.eval().requires_grad_(False)

    @classmethod
    def _empty(cls, record: Mapping[str, Any]) -> "AttentionGains":
        points, dim, modes = (count_of(record[name], name) for name in ("points", "dim", "modes"))
        encoder = like(record["encoder"], "", "encoder")
        shape = record_of(AttentionShape, record["shape"], "shape", added=ADDED_SETTINGS)
        if (most := max(shape.layers, shape.bands)) > _MAX_LAYERS:
            raise RecordError.expected(f"at most {_MAX_LAYERS}", most, name="layers")
        with torch.device("meta"):
            return cls(
                FeatureField(torch.empty(points, 3), torch.empty(points, dim), encoder),
                gain_scale=torch.empty(modes),
                shape=shape,
                generator=torch.Generator(device="cpu"),
                regions=(torch.empty(shape.clusters, 3), torch.empty(shape.clusters, dim)),
            )


class Attention(GainEstimator):
    """Trains the paper's network on the features of the fit."""

    name = NETWORK

    def digest(self) -> str:
        """Return the name."""
        return self.name

    def start(self, data: GainData, damping: str | None = None) -> tuple[AttentionGains, Int[Tensor, " contacts"]]:
        """Return an untrained network, and the points nearest to the contacts; `damping` in place of the config's."""
        features, config = data.features, data.config
        scale = data.gains.square().mean(0).sqrt()
        # Never zero: the network's output is measured in it.
        least = float(scale.max()) * 1e-6 + torch.finfo(scale.dtype).tiny
        network = AttentionGains(
            features,
            gain_scale=scale.clamp_min(least),
            shape=replace(config.shape, spatial_damping=(damping or config.damping) == PER_CONTACT),
            generator=torch.Generator().manual_seed(config.seed),
        )
        return network, features.nearest(data.train.contacts)

    def fit(self, data: GainData, trainer: Trainer) -> FittedGains:
        """Choose what the config leaves open on held-out training contacts, then train with all."""
        report = self._validated(data, trainer)
        network, rows = self.start(data, report["damping"])
        run = trainer.run("fit", network, data, rows, warmup=data.config.warmup_steps, steps=data.config.steps)
        return FittedGains(network.finished(run.order), run, data.train, report)

    def _validated(self, data: GainData, trainer: Trainer) -> dict[str, Any]:
        """Return the form of the dampings, and how it was decided."""
        config, train = data.config, data.train
        dampings = (SHARED, PER_CONTACT) if config.damping == "validated" else (config.damping,)
        held = held_out(train.contacts, config.validation)
        reason = ""
        if len(dampings) == 1:
            reason = "as set"
        elif not held:
            reason = f"no positions are held out to validate on, of at least {_MIN_PLACES}"
        if reason:
            return {"damping": dampings[0], "validated": False, "damping_reason": reason}
        learned, unseen = data.take([row for row in range(len(train)) if row not in held]), data.take(held)
        outcomes = {}
        for damping in dampings:
            name = f"trial with {damping} damping"
            if name not in trainer.trials:
                network, rows = self.start(learned, damping)
                trainer.run(
                    name, network, learned, rows, warmup=config.warmup_steps, steps=config.steps,
                    held=(unseen, data.features.nearest(unseen.train.contacts)),
                )  # fmt: skip
            outcomes[damping] = trainer.trials[name]
        best = min(outcomes, key=lambda damping: outcomes[damping]["envelope"])
        return {
            "damping": best,
            "validated": True,
            "damping_reason": "chosen on validation contacts",
            "validation_contacts": [train.names[row] for row in held],
            "validation_envelope": {damping: each["envelope"] for damping, each in outcomes.items()},
            "validation_spectral": {damping: each["spectral"] for damping, each in outcomes.items()},
        }


def held_out(contacts: Float[Tensor, "contacts 3"], fraction: float) -> list[int]:
    """Return all rows of the places, a fraction of all, that farthest-point sampling takes last; none of fewer than 6.

    Of single rows it would take repeats last, whose places are trained on.
    """
    rows = rows_by_place(contacts)
    if len(rows) < _MIN_PLACES:
        return []
    order = farthest_points(contacts[[each[0] for each in rows]], len(rows)).tolist()
    return [row for place in order[len(rows) - round(fraction * len(rows)) :] for row in rows[place]]


def encode(offsets: Float[Tensor, "*shape 3"], bands: int) -> Float[Tensor, "*shape encoded"]:
    """Return the offsets with sines and cosines of pi, 2 pi, 4 pi, ... times them (NeRF's encoding; paper: PE)."""
    angles = offsets[..., None] * (math.pi * 2.0 ** torch.arange(bands, dtype=offsets.dtype, device=offsets.device))
    waves = torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)
    return torch.cat([offsets, waves.flatten(-2)], dim=-1)
