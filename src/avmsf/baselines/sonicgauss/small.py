"""A small SonicGauss, trained from scratch: the published objective and conditioning, three million weights."""

import copy
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import read_tensors, write_tensors
from avmsf._utils.text import record_of
from avmsf.baselines.sonicgauss.conditioning import (
    CHANNELS,
    ContactEncoding,
    Fusion,
    Normalized,
    degree_one,
    normalized,
)
from avmsf.baselines.sonicgauss.patches import CHANNELS as LATENTS
from avmsf.baselines.sonicgauss.patches import PATCHES, PatchCodec, log_magnitudes, sounds_of, spectra
from avmsf.baselines.sonicgauss.training import (
    DROPPED,
    Loss,
    TrainingConfig,
    TunedRenderer,
    expect_sound,
    flow_loss,
    integrate,
    load_tensors,
    tune,
)
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.points import farthest_points

COMMAND = "python -m benchmarks baselines --parts sonicgauss-training --weights FILE"
"""What makes the weights."""
_KIND = FileKind("sonicgauss-small", "the weights of the small SonicGauss", f"make it: {COMMAND}", EvaluationError)
TUNING = TrainingConfig(steps=150, batch=8, rate=5e-4, warmup=20)
"""Fine-tuning to one object, whatever its number of recordings: half a minute on one core. The published program takes
80 rounds over the recordings in steps of two, at a rate of 1e-4, of weights that were trained for days."""


@dataclass(frozen=True)
class SmallConfig:
    """Sizes of the network."""

    width: int = 160
    heads: int = 5
    blocks: int = 5
    """Of the generator."""
    encoder_blocks: int = 2
    """Of the encoder of Gaussians."""
    tokens: int = 32
    """Gaussian tokens; the fusion doubles them."""


class SmallSonicGauss(nn.Module):
    """Velocity of latents, given an object's Gaussians and a contact."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, config: SmallConfig) -> None:
        super().__init__()
        width = config.width
        self.config = config
        self.register_buffer("mean", torch.zeros(CHANNELS))
        self.register_buffer("deviation", torch.ones(CHANNELS))
        self.embedding = nn.Linear(CHANNELS, width)
        layer = nn.TransformerEncoderLayer(
            width, config.heads, 4 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
        )
        self.encoder = nn.TransformerEncoder(layer, config.encoder_blocks, enable_nested_tensor=False)
        self.contact = ContactEncoding((64, 128), width)
        self.fusion = Fusion(width, config.heads)
        self.pooled = nn.Sequential(nn.Linear(width, width), nn.ReLU())
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.latents = nn.Linear(LATENTS, width)
        self.position = nn.Parameter(0.02 * torch.randn(PATCHES, width))
        self.blocks = nn.ModuleList(_Block(width, config.heads) for _ in range(config.blocks))
        self.last = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = nn.Linear(width, 2 * width)
        self.output = nn.Linear(width, LATENTS)
        for layer_of_zeros in (self.modulation, self.output):
            nn.init.zeros_(layer_of_zeros.weight)
            nn.init.zeros_(layer_of_zeros.bias)

    def condition(
        self, features: Float[Tensor, "batch tokens 23"], places: Float[Tensor, "batch 3"]
    ) -> Float[Tensor, "batch both width"]:
        """Return the tokens of objects and contacts."""
        tokens = self.encoder(self.embedding((features - self.mean) / self.deviation))
        fused: Tensor = self.fusion(tokens, self.contact(places))
        return fused

    def forward(
        self,
        latents: Float[Tensor, "batch patches channels"],
        times: Float[Tensor, " batch"],
        tokens: Float[Tensor, "batch both width"],
    ) -> Float[Tensor, "batch patches channels"]:
        """Return the velocity at latents and times, given what `condition` returns."""
        rates = torch.exp(-math.log(1e4) * torch.arange(self.config.width // 2) / (self.config.width // 2))
        angles = 1000.0 * times[:, None] * rates.to(times)
        control = self.time(torch.cat([angles.sin(), angles.cos()], dim=1)) + self.pooled(tokens.mean(1))
        state = torch.cat([tokens, self.latents(latents) + self.position], dim=1)
        for block in self.blocks:
            state = block(state, control)
        shift, scale = self.modulation(torch.nn.functional.silu(control))[:, None].chunk(2, dim=-1)
        velocity: Tensor = self.output(self.last(state[:, tokens.shape[1] :]) * (1 + scale) + shift)
        return velocity


class _Block(nn.Module):
    """Attention and perceptron side by side, modulated by time and condition: a single-stream block of Flux."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.modulation = nn.Linear(width, 3 * width)
        self.input = nn.Linear(width, 3 * width + 4 * width)
        self.output = nn.Linear(width + 4 * width, width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(
        self, state: Float[Tensor, "batch tokens width"], control: Float[Tensor, "batch width"]
    ) -> Float[Tensor, "batch tokens width"]:
        width = state.shape[-1]
        shift, scale, gate = self.modulation(torch.nn.functional.silu(control))[:, None].chunk(3, dim=-1)
        projected = self.input(self.norm(state) * (1 + scale) + shift)
        query, key, value = (
            each.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for each in projected[..., : 3 * width].chunk(3, dim=-1)
        )
        attended = torch.nn.functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        hidden = torch.nn.functional.gelu(projected[..., 3 * width :], approximate="tanh")
        return state + gate * self.output(torch.cat([attended, hidden], dim=-1))


@dataclass(frozen=True, eq=False)
class SmallWeights:
    """What training has made."""

    network: SmallSonicGauss
    codec: PatchCodec
    report: Mapping[str, Any]
    """Objects, steps, seed, losses and seconds, as plain values."""

    def write(self, path: Path) -> None:
        """Write one safetensors file. Raises EvaluationError where that cannot be."""
        tensors = _together(self.network, self.codec).state_dict()
        text = json.dumps({"config": asdict(self.network.config), "report": dict(self.report)})
        write_tensors(path, tensors, text, _KIND)

    @classmethod
    def read(cls, path: Path) -> "SmallWeights":
        """Read what `write` has written. Raises EvaluationError for anything else, and names a tensor that differs."""
        text, tensors = read_tensors(path, _KIND)
        try:
            content = json.loads(text)
            network = SmallSonicGauss(record_of(SmallConfig(), content["config"], "config"))
            report = dict(content["report"])
        except (ValueError, TypeError, KeyError, RuntimeError) as error:
            raise _KIND.damaged(path, error, name=_KIND.key) from error
        codec = PatchCodec()
        load_tensors(_together(network, codec), tensors, path, "copy the file again")
        return cls(network.eval(), codec, report)


def _together(network: SmallSonicGauss, codec: PatchCodec) -> nn.ModuleDict:
    return nn.ModuleDict({"network": network, "codec": codec})


def visible(cloud: GaussianCloud) -> Normalized:
    """Return an object's Gaussians in its unit cube. Raises EvaluationError where nothing can be seen of it."""
    return normalized(cloud, degree_one(cloud))


def object_tokens(found: Normalized, *, count: int) -> Float[Tensor, "tokens 23"]:
    """Return an object's features, mean over the cells around `count` far-apart Gaussians.

    A cell holds the Gaussians nearest to its own. Raises EvaluationError for fewer Gaussians than tokens.
    """
    centers = found.centers
    start = int((centers - centers.mean(0)).norm(dim=1).argmax())
    distances = torch.cdist(centers, centers[farthest_points(centers, count, start=start)])
    cells = torch.nn.functional.one_hot(distances.argmin(1), count).to(found.features)
    tokens: Tensor = (cells.T @ found.features) / cells.sum(0)[:, None].clamp(min=1.0)
    return tokens


def clip_loss(
    network: SmallSonicGauss,
    features: Float[Tensor, "objects tokens 23"],
    owners: Int[Tensor, " clips"],
    places: Float[Tensor, "clips 3"],
    latents: Float[Tensor, "clips patches channels"],
) -> Loss:
    """Return the flow's loss of clips by their rows, a tenth of the conditions zeroed; `owners` are rows of objects."""

    def loss(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Float[Tensor, ""]:
        kept = torch.rand(len(rows), 1, 1, generator=generator) >= DROPPED
        tokens = network.condition(features[owners[rows]], places[rows]) * kept
        return flow_loss(lambda state, times: network(state, times, tokens), latents[rows], generator=generator)

    return loss


def fit_small(
    weights: SmallWeights, cloud: GaussianCloud, train: Impacts, config: TrainingConfig = TUNING, *, seed: int = 0
) -> TunedRenderer:
    """Fine-tune all of the network to an object's recordings, by the objective that it was trained with.

    Phases are sought from those of the mean recording on. Raises EvaluationError where the recordings are silent, and
    where nothing can be seen of the object.
    """
    network, codec, seen = copy.deepcopy(weights.network), weights.codec, visible(cloud)
    features = object_tokens(seen, count=network.config.tokens)[None]
    found = spectra(train.sounds, train.sample_rate)
    largest, phases = float(found.abs().max()), found.mean(0).angle()
    expect_sound(largest, train)
    latents = codec.encode(log_magnitudes(found, largest))
    owners = torch.zeros(len(train), dtype=torch.int64)
    noise = torch.randn(1, PATCHES, LATENTS, generator=torch.Generator().manual_seed(seed))

    def generate(place: Float[Tensor, "1 3"], steps: int) -> Float[Tensor, " samples"]:
        tokens = network.condition(features, place)
        flown = integrate(lambda state, times: network(state, times, tokens), noise, steps=steps)
        # Training has seen no magnitude above the largest.
        magnitudes = largest * 10.0 ** codec.decode(flown).clamp(max=0.0)
        return sounds_of(magnitudes, phases, sample_rate=train.sample_rate, samples=train.sounds.shape[1])[0]

    loss = clip_loss(network.train(), features, owners, seen.places(train.contacts), latents)
    return tune(network, network.parameters(), loss, train, config, seed=seed, seen=seen, generate=generate)
