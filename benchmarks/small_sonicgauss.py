"""A small SonicGauss, trained from scratch: the published objective and conditioning, three million weights.

It generates latents of log spectrograms: patches of 16 bins (250 Hz) over all of 2 s at 32 kHz, 64 of which reach
16 kHz, by principal components. Decays are smooth and lines sharp, so that few components of a patch keep both. Phases
are found by Griffin and Lim's algorithm. Importing this module adds the method `sonicgauss-small:FILE` to those of
`avmsf evaluate`.
"""

import copy
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor, nn

from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import read_tensors, write_tensors
from avmsf._utils.text import record_of
from avmsf.baselines.sonicgauss.conditioning import CHANNELS, ContactEncoding, Fusion, Normalized, normalized
from avmsf.baselines.sonicgauss.training import (
    DROPPED,
    Loss,
    TrainingConfig,
    TunedRenderer,
    expect_sound,
    flow_loss,
    integrate,
    load_tensors,
    train,
)
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import METHODS, MethodEntry
from avmsf.evaluation.task import Task
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.mesh.points import farthest_points
from avmsf.modal.spectra import resampled, with_length

RATE = 32_000.0
"""Hz."""
SAMPLES = 64_000
FFT, HOP = 2048, 512
PATCHES, BINS = 64, 16
FRAMES = 1 + SAMPLES // HOP
VALUES = BINS * FRAMES
LATENTS = 32
"""Principal components of a patch; further ones hold the noise of single recordings."""
FLOOR = -4.0
"""Decadic logarithm of the least magnitude, over the object's largest."""
_CURVE = 20
"""Points of the loss curve that weights keep."""
_ITERATIONS, _MOMENTUM = 32, 0.99 / 1.99
"""Of the fast Griffin-Lim algorithm (Perraudin et al. 2013), as torchaudio has them by default."""


class PatchCodec(nn.Module):
    """A linear map of log spectrograms to latents and back: orthonormal components, and what they are divided by."""

    mean: Tensor
    components: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(VALUES))
        self.register_buffer("components", torch.zeros(VALUES, LATENTS))
        self.register_buffer("scale", torch.ones(LATENTS))

    @classmethod
    def of(cls, logs: Sequence[Float[Tensor, "contacts bins frames"]], *, seed: int) -> "PatchCodec":
        """Return the principal components of log spectrograms' patches.

        Coefficients are divided by the root of their deviation: faint ones, mostly noise, stay fainter than the rest.
        """
        rows, codec = torch.cat([_patches(each).flatten(0, 1) for each in logs]), cls()
        codec.mean = rows.mean(0)
        rows = rows - codec.mean
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            components = torch.pca_lowrank(rows, q=2 * LATENTS, center=False, niter=3)[2][:, :LATENTS]
        codec.components = components.contiguous()
        deviation = (rows @ components).std(0)
        codec.scale = (deviation * deviation.max()).sqrt()
        return codec

    def encode(self, logs: Float[Tensor, "contacts bins frames"]) -> Float[Tensor, "contacts patches channels"]:
        """Return the latents of log spectrograms."""
        return ((_patches(logs) - self.mean) @ self.components) / self.scale

    def decode(self, latents: Float[Tensor, "contacts patches channels"]) -> Float[Tensor, "contacts bins frames"]:
        """Return the log spectrograms of latents."""
        rows = (latents * self.scale) @ self.components.T + self.mean
        return rows.reshape(len(rows), PATCHES * BINS, FRAMES)


def spectra(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> Complex[Tensor, "contacts bins frames"]:
    """Return spectra of the first 2 s at 32 kHz; shorter sounds are continued by silence. Hann windows, centered."""
    clips = with_length(resampled(sounds.float(), sample_rate=sample_rate, wanted=RATE), SAMPLES)
    found = torch.stft(
        clips, FFT, HOP, window=torch.hann_window(FFT), center=True, pad_mode="constant", return_complex=True
    )
    return found[:, : PATCHES * BINS]


def log_magnitudes(
    spectrum: Complex[Tensor, "contacts bins frames"], largest: float
) -> Float[Tensor, "contacts bins frames"]:
    """Return decadic logarithms of magnitudes over the largest, `FLOOR` and above."""
    return (spectrum.abs() / largest).clamp(min=10.0**FLOOR).log10()


def sounds_of(
    magnitudes: Float[Tensor, "contacts bins frames"],
    phases: Float[Tensor, "bins frames"],
    *,
    sample_rate: float,
    samples: int,
) -> Float[Tensor, "contacts samples"]:
    """Return sounds of these magnitudes, whose phases are sought from the given ones on (fast Griffin-Lim)."""
    window = torch.hann_window(FFT)
    # The bin at half the rate is not kept.
    magnitudes, phases = (torch.nn.functional.pad(each, (0, 0, 0, 1)) for each in (magnitudes, phases))
    found = torch.polar(magnitudes, phases.expand_as(magnitudes).contiguous())
    before = torch.zeros_like(found)
    for _ in range(_ITERATIONS):
        sounds = torch.istft(found, FFT, HOP, window=window, length=SAMPLES)
        now = torch.stft(sounds, FFT, HOP, window=window, center=True, pad_mode="constant", return_complex=True)
        found = torch.polar(magnitudes, (now - _MOMENTUM * before).angle())
        before = now
    sounds = torch.istft(found, FFT, HOP, window=window, length=SAMPLES)
    return with_length(resampled(sounds, sample_rate=RATE, wanted=sample_rate), samples)


def _patches(logs: Float[Tensor, "contacts bins frames"]) -> Float[Tensor, "contacts patches values"]:
    return logs.reshape(len(logs), PATCHES, VALUES)


NAME = "sonicgauss-small"
"""Of the method, and of its files' kind."""
COMMAND = "python -m benchmarks baselines --parts sonicgauss-training"
"""What makes the weights."""
_KIND = FileKind(NAME, "the weights of the small SonicGauss", f"make it: {COMMAND}", EvaluationError)
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
            network = SmallSonicGauss(record_of(SmallConfig, content["config"], "config"))
            report = dict(content["report"])
        except (ValueError, TypeError, KeyError, RuntimeError) as error:
            raise _KIND.damaged(path, error, name=_KIND.key) from error
        codec = PatchCodec()
        load_tensors(_together(network, codec), tensors, path, "copy the file again")
        return cls(network.eval(), codec, report)


def _together(network: SmallSonicGauss, codec: PatchCodec) -> nn.ModuleDict:
    return nn.ModuleDict({"network": network, "codec": codec})


def visible(cloud: GaussianCloud) -> Normalized:
    """Return an object's Gaussians in its unit cube, with the coefficients of degree 1 of red, green and blue.

    Coefficients are zeros where the cloud has none. Raises EvaluationError where nothing can be seen of the object.
    """
    rest = cloud.harmonics[:, 1:4]
    return normalized(cloud, torch.nn.functional.pad(rest, (0, 0, 0, 3 - rest.shape[1])).flatten(1))


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


def train_small(
    objects: Iterable[tuple[GaussianCloud, Impacts]], sizes: SmallConfig, config: TrainingConfig, *, seed: int = 0
) -> SmallWeights:
    """Train from scratch on objects' Gaussians and recordings. Raises EvaluationError where there is no object."""
    tokens, places, logs = [], [], []
    for cloud, impacts in objects:
        seen = visible(cloud)
        found = spectra(impacts.sounds, impacts.sample_rate)
        tokens.append(object_tokens(seen, count=sizes.tokens))
        places.append(seen.places(impacts.contacts.float()))
        logs.append(log_magnitudes(found, float(found.abs().max())))
    if not tokens:
        raise EvaluationError.expected("objects to train on", 0, name="objects")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SmallSonicGauss(sizes)
    features = torch.stack(tokens)
    network.mean.copy_(features.mean((0, 1)))
    network.deviation.copy_(features.std((0, 1)).clamp(min=1e-3))
    codec = PatchCodec.of(logs, seed=seed)
    owners = torch.cat([torch.full((len(each),), row) for row, each in enumerate(places)])
    latents = torch.cat([codec.encode(each) for each in logs])
    logs.clear()
    loss = clip_loss(network.train(), features, owners, torch.cat(places), latents)
    losses = torch.as_tensor(train(network.parameters(), loss, len(owners), config, seed=seed))
    report = {"objects": len(tokens), "clips": len(owners), "steps": config.steps, "batch": config.batch, "seed": seed}
    parts = torch.tensor_split(losses, min(_CURVE, len(losses)))
    return SmallWeights(network.eval(), codec, report | {"losses": [round(float(each.mean()), 4) for each in parts]})


def fit_small(
    weights: SmallWeights, cloud: GaussianCloud, recordings: Impacts, config: TrainingConfig = TUNING, *, seed: int = 0
) -> TunedRenderer:
    """Fine-tune all of the network to an object's recordings, by the objective that it was trained with.

    Phases are sought from those of the mean recording on. Raises EvaluationError where the recordings are silent, and
    where nothing can be seen of the object.
    """
    network, codec, seen = copy.deepcopy(weights.network), weights.codec, visible(cloud)
    features = object_tokens(seen, count=network.config.tokens)[None]
    found = spectra(recordings.sounds, recordings.sample_rate)
    largest, phases = float(found.abs().max()), found.mean(0).angle()
    expect_sound(largest, recordings)
    latents = codec.encode(log_magnitudes(found, largest))
    owners = torch.zeros(len(recordings), dtype=torch.int64)
    noise = torch.randn(1, PATCHES, LATENTS, generator=torch.Generator().manual_seed(seed))

    def generate(place: Float[Tensor, "1 3"], steps: int) -> Float[Tensor, " samples"]:
        tokens = network.condition(features, place)
        flown = integrate(lambda state, times: network(state, times, tokens), noise, steps=steps)
        # Training has seen no magnitude above the largest.
        magnitudes = largest * 10.0 ** codec.decode(flown).clamp(max=0.0)
        return sounds_of(magnitudes, phases, sample_rate=recordings.sample_rate, samples=recordings.sounds.shape[1])[0]

    loss = clip_loss(network.train(), features, owners, seen.places(recordings.contacts), latents)
    train(network.parameters(), loss, len(recordings), config, seed=seed)
    network.eval()
    return TunedRenderer(seen, recordings.sample_rate, recordings.sounds.shape[1], generate)


def fit_task(task: Task, *, path: Path) -> TunedRenderer:
    """Fine-tune the generator of a file: the method `sonicgauss-small:FILE` of `avmsf evaluate`."""
    return fit_small(SmallWeights.read(path), task.gaussians(), task.train, seed=task.seed)


METHODS[NAME] = MethodEntry(
    "SonicGauss's objective at a small size, trained from scratch on simulated objects",
    fit_task,
    path=f"a file, which {COMMAND} makes",
)
