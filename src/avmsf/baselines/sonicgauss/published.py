"""SonicGauss (Wang et al. 2025) as published, from a user's copy of its weights; needs the extra `text` (diffusers).

The folder is the one that the project's download makes: `model.safetensors` (Oobleck autoencoder), `model_1` (Flux
transformer with its pooled projection and duration), `model_2` (encoder of Gaussians), `model_3` (contact) and
`model_4` (fusion). The text encoder and the decoder of Gaussians in these files are not used and not read."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from avmsf.baselines.sonicgauss.conditioning import (
    CHANNELS,
    ContactEncoding,
    Fusion,
    Normalized,
    first_nine,
    normalized,
)
from avmsf.baselines.sonicgauss.point_transformer import EncoderSizes, PointEncoder
from avmsf.baselines.sonicgauss.training import (
    DROPPED,
    TrainingConfig,
    TunedRenderer,
    expect_sound,
    flow_loss,
    integrate,
    load_tensors,
    train,
)
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError, from_extra
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.spectra import resampled, with_length

FRAMES: Final = 64
"""Of latents, and tokens of Gaussians."""
LONGEST = 2.98
"""Seconds of the longest clip that the weights were trained on."""
_UNUSED = ("text_encoder.", "feature_predictor.backbone.backbone.dec.", "feature_predictor.features_outputhead.")
_DOWNLOAD = "hf download AiEson2/SonicGauss --local-dir FOLDER"


@dataclass(frozen=True)
class PublishedSizes:
    """Sizes of all parts; the defaults are the published ones."""

    encoder: EncoderSizes = field(default_factory=EncoderSizes)
    width: int = 1024
    """Of tokens."""
    contact: tuple[int, ...] = (256, 512)
    fusion_heads: int = 8
    transformer: Mapping[str, Any] = field(
        default_factory=lambda: (
            {"num_layers": 3, "num_single_layers": 9, "attention_head_dim": 128}
            | {"num_attention_heads": 4, "in_channels": 64, "axes_dims_rope": (16, 56, 56)}
        )
    )
    """Of diffusers' FluxTransformer2DModel."""
    autoencoder: Mapping[str, Any] = field(default_factory=dict)
    """Of diffusers' AutoencoderOobleck, whose defaults are those of Stable Audio Open."""


class _Fourier(nn.Module):
    """A number, and its sines and cosines at random frequencies."""

    def __init__(self) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.randn(128))

    def forward(self, values: Float[Tensor, " batch"]) -> Float[Tensor, "batch dim"]:
        angles = values[:, None] * self.weights * 2.0 * math.pi
        return torch.cat([values[:, None], angles.sin(), angles.cos()], dim=1)


class _Generator(nn.Module):
    def __init__(self, sizes: PublishedSizes) -> None:
        super().__init__()
        width = sizes.width
        self.fc = nn.Sequential(nn.Linear(width, width), nn.ReLU())
        # The published names.
        embedding = nn.Sequential(_Fourier(), nn.Linear(257, width))
        self.duration_emebdder = nn.ModuleDict({"time_positional_embedding": embedding})
        self.transformer = _diffusers()[1](
            **sizes.transformer, joint_attention_dim=width, pooled_projection_dim=width, guidance_embeds=False
        )


class _GaussianEncoder(nn.Module):
    def __init__(self, sizes: PublishedSizes) -> None:
        super().__init__()
        backbone = PointEncoder(CHANNELS, sizes.encoder)
        self.feature_predictor = nn.ModuleDict({"backbone": nn.ModuleDict({"backbone": backbone})})
        self.projection = nn.Linear(sizes.encoder.channels[-1], sizes.width)

    def forward(self, seen: Normalized) -> Float[Tensor, "1 tokens width"]:
        """Return 64 tokens: evenly thinned along the order of voxels, or continued by zeros."""
        backbone = self.feature_predictor["backbone"]["backbone"]  # type: ignore[index]
        device = self.projection.weight.device
        tokens: Tensor = self.projection(backbone(seen.centers.to(device), seen.features.to(device)))
        if len(tokens) > FRAMES:
            tokens = tokens[torch.linspace(0, len(tokens) - 1, FRAMES).long()]
        return torch.nn.functional.pad(tokens, (0, 0, 0, FRAMES - len(tokens)))[None]


class PublishedSonicGauss(nn.Module):
    """All parts of the published model."""

    def __init__(self, sizes: PublishedSizes) -> None:
        super().__init__()
        self.sizes = sizes
        with warnings.catch_warnings():
            # Nothing that a user of this package could change.
            warnings.filterwarnings("ignore", message="`torch.nn.utils.weight_norm` is deprecated")
            self.autoencoder = _diffusers()[0](**sizes.autoencoder)
        self.generator = _Generator(sizes)
        self.gaussians = _GaussianEncoder(sizes)
        self.contact = ContactEncoding(sizes.contact, sizes.width)
        self.fusion = Fusion(sizes.width, sizes.fusion_heads)

    @classmethod
    def load(cls, folder: Path, sizes: PublishedSizes | None = None) -> "PublishedSonicGauss":
        """Read the published files.

        Raises EvaluationError where diffusers is missing, for a file that is missing or cannot be read, and for tensors
        that are missing, of another shape, or of another model, the first of which it names.
        """
        model = cls(PublishedSizes() if sizes is None else sizes)
        for name, part in model.files().items():
            _load(part, folder / name)
        return model.eval()

    def files(self) -> dict[str, nn.Module]:
        """Return which file holds the weights of which part."""
        return {
            "model.safetensors": self.autoencoder,
            "model_1.safetensors": self.generator,
            "model_2.safetensors": self.gaussians,
            "model_3.safetensors": self.contact,
            "model_4.safetensors": self.fusion,
        }

    def trained(self) -> list[nn.Parameter]:
        """Return what is fine-tuned: all but the autoencoder and the duration."""
        parts = (self.generator.transformer, self.generator.fc, self.gaussians, self.contact, self.fusion)
        return [weight for part in parts for weight in part.parameters()]

    def condition(
        self, tokens: Float[Tensor, "1 tokens width"], places: Float[Tensor, "batch 3"]
    ) -> Float[Tensor, "batch both width"]:
        """Return the tokens of an object, as `gaussians` encodes it, and of contacts in its cube."""
        fused: Tensor = self.fusion(tokens.expand(len(places), -1, -1), self.contact(places))
        return fused

    def velocity(
        self,
        latents: Float[Tensor, "batch frames channels"],
        times: Float[Tensor, " batch"],
        tokens: Float[Tensor, "batch both width"],
        *,
        seconds: float,
        kept: Float[Tensor, "batch 1 1"] | None = None,
    ) -> Float[Tensor, "batch frames channels"]:
        """Return the velocity of latents of sounds that last `seconds`; tokens are multiplied by `kept`.

        What is pooled of the tokens stays, as published.
        """
        pooled = self.generator.fc(tokens.mean(1))
        embedding = self.generator.duration_emebdder["time_positional_embedding"]
        duration = embedding(times.new_full((len(times),), min(max(seconds, 0.0), LONGEST) / LONGEST))
        states = torch.cat([tokens, duration[:, None]], dim=1)
        found: Tensor = self.generator.transformer(
            hidden_states=latents,
            timestep=times,
            guidance=None,
            pooled_projections=pooled,
            encoder_hidden_states=states if kept is None else states * kept,
            txt_ids=latents.new_zeros(states.shape[1], 3),
            img_ids=torch.arange(latents.shape[1], device=latents.device)[:, None].expand(-1, 3).to(latents),
            return_dict=False,
        )[0]
        return found


def _load(part: nn.Module, path: Path) -> None:
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys() if not name.startswith(_UNUSED)}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        wanted = "published weights of SonicGauss"
        raise EvaluationError.expected(wanted, got=str(error), file=path, advice=_DOWNLOAD) from error
    load_tensors(part, tensors, path, _DOWNLOAD)


def _diffusers() -> tuple[Any, Any]:
    with from_extra("text", "diffusers", raising=EvaluationError):
        from diffusers import AutoencoderOobleck, FluxTransformer2DModel
    return AutoencoderOobleck, FluxTransformer2DModel


EPOCHS, BATCH = 80, 2
"""Rounds over an object's recordings, and recordings a step, as published."""


def fit_published(
    model: PublishedSonicGauss, cloud: GaussianCloud, impacts: Impacts, *, seed: int = 0
) -> TunedRenderer:
    """Fine-tune a model in place to an object's recordings, as published, on the device where it is.

    Recordings are divided by the loudest one's peak; generated sounds end after 2.97 s. Batch norms keep their
    statistics, and the last weights are taken: there are too few recordings to leave some out. Raises EvaluationError
    where the recordings are silent, and where nothing can be seen of the object.
    """
    device = _device_of(model)
    seen = normalized(cloud, first_nine(cloud))
    peak = float(impacts.sounds.abs().max())
    expect_sound(peak, impacts)
    contacts = seen.places(impacts.contacts).float().to(device)
    means, deviations = _encoded(model, impacts, peak)
    frames = torch.randn(1, *means.shape[1:], generator=torch.Generator().manual_seed(seed)).to(device)

    def loss(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Tensor:
        seconds = min(impacts.duration, LONGEST)
        noise = torch.randn(means[rows].shape, generator=generator)
        latents = (means[rows] + deviations[rows] * noise).to(device)
        kept = (torch.rand(len(rows), 1, 1, generator=generator) >= DROPPED).to(latents)
        tokens = model.condition(model.gaussians(seen), contacts[rows.to(device)])
        return flow_loss(
            lambda z, s: model.velocity(z, s, tokens, seconds=seconds, kept=kept), latents, generator=generator
        )

    # The encoded Gaussians are the same for all contacts.
    encoded = cache(lambda: model.gaussians(seen))

    def generate(place: Float[Tensor, "1 3"], steps: int) -> Float[Tensor, " samples"]:
        tokens, seconds = model.condition(encoded(), place.to(device)), impacts.duration
        latents = integrate(lambda z, s: model.velocity(z, s, tokens, seconds=seconds), frames, steps=steps)
        sound = model.autoencoder.decode(latents.mT).sample.mean(1).float().cpu()
        rate = float(model.autoencoder.config.sampling_rate)
        sound = resampled(sound, sample_rate=rate, wanted=impacts.sample_rate)
        return peak * with_length(sound, impacts.sounds.shape[1])[0]

    config = TrainingConfig(steps=EPOCHS * math.ceil(len(impacts) / BATCH), batch=BATCH)
    model.train().autoencoder.eval()
    for part in model.gaussians.modules():
        if isinstance(part, torch.nn.BatchNorm1d):
            part.eval()
    train(model.trained(), loss, len(impacts), config, seed=seed)
    model.eval()
    return TunedRenderer(seen, impacts.sample_rate, impacts.sounds.shape[1], generate)


@torch.no_grad()
def _encoded(
    model: PublishedSonicGauss, impacts: Impacts, peak: float
) -> tuple[Float[Tensor, "contacts frames channels"], Float[Tensor, "contacts frames channels"]]:
    """Return means and deviations of the recordings' latents; published training draws from them anew each time."""
    autoencoder = model.autoencoder
    rate, samples = float(autoencoder.config.sampling_rate), FRAMES * int(autoencoder.hop_length)
    sounds = with_length(
        resampled(impacts.sounds.float() / peak, sample_rate=impacts.sample_rate, wanted=rate), samples
    )
    channels = int(autoencoder.config.audio_channels)
    found = [
        autoencoder.encode(each[None, None].expand(-1, channels, -1).to(_device_of(model))).latent_dist
        for each in sounds
    ]
    return torch.cat([each.mean for each in found]).mT.cpu(), torch.cat([each.std for each in found]).mT.cpu()


def _device_of(model: PublishedSonicGauss) -> torch.device:
    return next(model.fusion.parameters()).device
