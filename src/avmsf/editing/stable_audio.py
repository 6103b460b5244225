"""Stable Audio through diffusers (extra `text`): from the hub or its cache, or from a local folder.

Its denoiser predicts v = cos(a) noise - sin(a) z from cos(a) z + sin(a) noise at the angle a = pi t / 2; diffusers'
scheduler words the same with sigma = tan(a) in the latents z + sigma noise, and its preconditioning is used here, so
that a pipeline with another scheduler of that family is taken at its word.
"""

import hashlib
import json
import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avmsf._utils.arrays import Seed, generator_of
from avmsf._utils.device import usable_device
from avmsf._utils.files import model_folder
from avmsf.editing.config import STABLE_AUDIO, check_prompt
from avmsf.errors import EditError, download_failure, from_extra
from avmsf.modal.spectra import with_length

Latents = Float[Tensor, "contacts dim frames"]
"""What the autoencoder makes of waveforms."""
Waveforms = Float[Tensor, "contacts channels samples"]
"""At the model's sample rate."""


@dataclass(frozen=True, eq=False)
class Conditioning:
    """What the denoiser is conditioned on, without the words and with them."""

    text: Float[Tensor, "2 words dim"]
    """Embedded words and times, for cross-attention."""
    times: Float[Tensor, "2 1 twice"]
    """Embedded start and end."""


class StableAudio:
    """A `StableAudioPipeline`: its autoencoder, text encoder and denoiser; all frozen."""

    def __init__(self, pipeline: Any, *, name: str, seconds: float | None = None) -> None:
        """Wrap a pipeline on whatever device it is.

        `seconds` is how much the denoiser works at; None is all that it was trained on, 47 s for Stable Audio Open,
        which costs in proportion. The autoencoder is only given what sounds. Raises `EditError` for more seconds than
        the model has.
        """
        self.pipeline, self.name = pipeline, name
        self.sample_rate = float(pipeline.vae.config.sampling_rate)
        """Of its waveforms, Hz."""
        self.channels = int(pipeline.vae.config.audio_channels)
        """Of its waveforms."""
        for part in (pipeline.vae, pipeline.text_encoder, pipeline.projection_model, pipeline.transformer):
            part.eval().requires_grad_(False)
        pipeline.set_progress_bar_config(disable=True)
        self._hop = int(pipeline.vae.hop_length)
        self._longest = int(pipeline.transformer.config.sample_size)
        self._frames = self._longest if seconds is None else self._frames_of(seconds)
        self._reach = _reach(pipeline.vae.config.downsampling_ratios)

    @property
    def device(self) -> torch.device:
        """Where it computes now."""
        return next(self.pipeline.transformer.parameters()).device

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the denoiser."""
        return next(self.pipeline.transformer.parameters()).dtype

    @classmethod
    def load(
        cls,
        source: str | Path = STABLE_AUDIO,
        *,
        seconds: float | None = None,
        device: str | torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> "StableAudio":
        """Load a pipeline of the hub by name, or a folder that holds one.

        On CUDA and in bfloat16 where there is a GPU, else on the CPU in float32, by default. Raises `EditError` where
        diffusers is missing, where the model is neither here nor to be downloaded (its license has to be accepted
        first), for a folder that holds another model or a part of one, and for a device that is not there or whose
        memory does not hold the model.
        """
        place = usable_device(device, raising=EditError)
        precision = dtype or (torch.bfloat16 if place.type == "cuda" else torch.float32)
        pipeline, name = _load_pipeline(source, precision)
        try:
            pipeline = pipeline.to(place)
        except torch.OutOfMemoryError as error:
            raise _no_memory(name, place) from error
        return cls(pipeline, name=name, seconds=seconds)

    def describe(self) -> dict[str, Any]:
        """Return a digest of its weights and configurations, the frames that it works at, and its precision."""
        return {"weights_sha256": self._digest, "frames": self._frames, "precision": str(self.dtype)}

    @cached_property
    def _digest(self) -> str:
        """What tells it from others wherever its files are: of its settings and samples of its weights."""
        found = hashlib.sha256()
        for part in (*_NETWORKS, "scheduler"):
            config = getattr(self.pipeline, part).config
            settings = config if isinstance(config, dict) else config.to_dict()
            # Those that begin with an underscore name the folder and the libraries' versions.
            plain = {key: each for key, each in settings.items() if not key.startswith("_") and key not in _ON_SAVING}
            found.update(f"{part} {json.dumps(plain, sort_keys=True, default=str)}".encode())
        for part in _NETWORKS:
            for key, weight in getattr(self.pipeline, part).state_dict().items():
                rows = torch.linspace(0, weight.numel() - 1, min(weight.numel(), _SAMPLED), dtype=torch.float64).long()
                sampled = weight.flatten()[rows.to(weight.device)].cpu().double()
                found.update(f"{part} {key} {weight.dtype} {tuple(weight.shape)}".encode())
                found.update(sampled.numpy().tobytes())
        return found.hexdigest()

    def encode(self, waveforms: Waveforms) -> Latents:
        """Return the means of the autoencoder's latents, continued by silence to the frames that are worked at."""
        samples = waveforms.shape[2]
        if samples > self._frames * self._hop:
            wanted = f"sounds of at most {self._frames * self._hop / self.sample_rate:.4g} s for {self.name}"
            advice = "load the model with more seconds, or edit with fewer"
            raise EditError.expected(wanted, samples / self.sample_rate, name="seconds", advice=advice)
        # Beyond the reach of its filters the autoencoder hears silence alone, and says the same of all of it; as far
        # from the end of what it is given, it would hear that end.
        sounding = math.ceil(samples / self._hop) + self._reach
        given = min(self._frames, sounding + self._reach)
        rows = with_length(waveforms.flatten(0, 1), given * self._hop).reshape(*waveforms.shape[:2], -1)
        latents = self._encoded(rows)
        if given == self._frames:
            return latents
        silence = self._silence.expand(len(latents), -1, self._frames - sounding)
        return torch.cat([latents[:, :, :sounding], silence], dim=2)

    def decode(self, latents: Latents, *, samples: int) -> Waveforms:
        """Return the beginning of the latents' waveforms; what cannot reach it is not decoded."""
        frames = math.ceil(samples / self._hop) + self._reach
        with torch.no_grad():
            decoded: Tensor = self.pipeline.vae.decode(latents[:, :, :frames].float()).sample
        return decoded[:, :, :samples]

    def embed(self, prompt: str, *, seconds: float) -> Conditioning:
        """Return the embedding of a prompt, for a sound that starts at 0 and lasts `seconds`."""
        pipeline, device = self.pipeline, self.device
        with torch.no_grad():
            words = pipeline.encode_prompt(prompt, device, False, None)
            times = pipeline.encode_duration(0.0, seconds, device, False, 1)
            conditional = torch.cat([words, *times], dim=1)
        both = torch.cat(times, dim=2)
        # Without words the denoiser has no condition, the times of the cross-attention included.
        return Conditioning(torch.cat([torch.zeros_like(conditional), conditional]), torch.cat([both, both]))

    def denoised(
        self, latents: Latents, level: Float[Tensor, " contacts"], conditioning: Conditioning, *, guidance: float
    ) -> Latents:
        """Return the clean latents that the model sees in noisy ones."""
        from diffusers.models.embeddings import get_1d_rotary_pos_embed

        scheduler, count = self.pipeline.scheduler, len(latents)
        angle = (0.5 * math.pi * level)[:, None, None]
        sigma = torch.tan(angle)
        noisy = latents / torch.cos(angle)
        taken = [1] if guidance == 1.0 else [0, 1]
        rows = torch.tensor(taken, device=latents.device).repeat_interleave(count)
        rotary = get_1d_rotary_pos_embed(
            self.pipeline.rotary_embed_dim,
            latents.shape[2] + conditioning.times.shape[1],
            use_real=True,
            repeat_interleave_real=False,
        )
        with torch.no_grad():
            predicted = self.pipeline.transformer(
                scheduler.precondition_inputs(noisy, sigma).repeat(len(taken), 1, 1).to(self.dtype),
                scheduler.precondition_noise(sigma).flatten().repeat(len(taken)),
                encoder_hidden_states=conditioning.text[rows],
                global_hidden_states=conditioning.times[rows],
                rotary_embedding=tuple(each.to(latents.device) for each in rotary),
                return_dict=False,
            )[0].float()
        parts = predicted.reshape(len(taken), *latents.shape)
        guided = parts[0] if len(taken) == 1 else parts[0] + guidance * (parts[1] - parts[0])
        clean: Tensor = scheduler.precondition_outputs(noisy, guided, sigma)
        return clean

    def generate(
        self, prompt: str, *, seconds: float, seed: Seed = None, steps: int = 100, guidance: float = 7.0
    ) -> Float[Tensor, " samples"]:
        """Return a sound generated from a prompt alone, mono at the model's rate, by the pipeline's own sampler.

        Without a `seed` it is that of the seed 0.

        Raises `EditError` for an empty prompt, more seconds than the model has, and where memory runs out.
        """
        words = check_prompt(prompt)
        self._frames_of(seconds)
        try:
            with warnings.catch_warnings():
                # Its schedule ends at 500 in float32, a last digit beyond what the sampler's noise was made for.
                warnings.filterwarnings("ignore", message="Should have t[ab]")
                # Latents, for the pipeline would give the autoencoder the denoiser's precision.
                latents = self.pipeline(
                    words,
                    audio_end_in_s=seconds,
                    num_inference_steps=steps,
                    guidance_scale=guidance,
                    generator=generator_of(seed),
                    output_type="latent",
                ).audios
            return self.decode(latents, samples=round(seconds * self.sample_rate))[0].mean(dim=0).cpu()
        except torch.OutOfMemoryError as error:
            raise _no_memory(f"a sound of {self.name}", self.device) from error

    def _frames_of(self, seconds: float) -> int:
        """Return how many frames hold a length of time. Raises `EditError` for more than the model has."""
        longest = self._longest * self._hop / self.sample_rate
        if not 0 < seconds <= longest:
            raise EditError.expected(f"more than 0 and at most {longest:.4g} for {self.name}", seconds, name="seconds")
        return math.ceil(seconds * self.sample_rate / self._hop)

    def _encoded(self, waveforms: Waveforms) -> Latents:
        with torch.no_grad():
            latents: Tensor = self.pipeline.vae.encode(waveforms.to(self.device).float()).latent_dist.mode()
        return latents

    @cached_property
    def _silence(self) -> Float[Tensor, "1 dim 1"]:
        """The latent of silence."""
        silence = torch.zeros(1, self.channels, (2 * self._reach + 1) * self._hop)
        return self._encoded(silence)[:, :, self._reach : self._reach + 1]


def _reach(strides: list[int]) -> int:
    """Return how many frames to each side the autoencoder's filters see at most.

    Each level has three residual filters of 7 taps, dilated by 1, 3 and 9, at the rate above its stride, and one as
    wide as its stride; at the ends are filters of at most 7 taps, at the waveform's rate and at the frames'.
    """
    rates = [math.prod(strides[:level]) for level in range(len(strides) + 1)]
    return math.ceil((3 + sum(39 * rate for rate in rates[:-1]) + sum(rates[1:]) + 3 * rates[-1]) / rates[-1])


_NETWORKS: Final = ("vae", "text_encoder", "projection_model", "transformer")
_SAMPLED = 64
"""Numbers of each weight that a digest looks at, evenly spaced."""
_ON_SAVING: Final = ("architectures", "dtype", "torch_dtype", "transformers_version")
"""Settings that transformers adds when it saves: they say nothing that the weights do not."""
_HOW_TO_GET = (
    "accept the license at https://huggingface.co/{name}, create a token at https://huggingface.co/settings/tokens and "
    "run hf auth login; or, on a computer with a network, run hf download {name} --local-dir FOLDER --exclude "
    "'model.*', copy FOLDER here and give its path"
)


def _load_pipeline(source: str | Path, dtype: torch.dtype) -> tuple[Any, str]:
    """Return a `StableAudioPipeline` on the CPU and what it is to be called. Raises `EditError`.

    All but its autoencoder is in `dtype`: in bfloat16 a waveform would have eight bits.
    """
    kind = _pipeline_class()
    what = f"a folder with a {kind.__name__}, or a name of the hub such as {STABLE_AUDIO}"
    folder = model_folder(source, what, raising=EditError)
    name = folder.resolve().name if folder else str(source)
    try:
        place = folder or _downloaded(kind, name)
        with warnings.catch_warnings():
            # No user of this package can fix it.
            warnings.filterwarnings("ignore", message="`torch.nn.utils.weight_norm` is deprecated")
            pipeline = kind.from_pretrained(place, local_files_only=True, use_safetensors=True)
        for part in ("precondition_inputs", "precondition_noise", "precondition_outputs"):
            if not hasattr(pipeline.scheduler, part):
                raise ValueError(f"the scheduler {type(pipeline.scheduler).__name__}, not of the EDM family")
        for part in _NETWORKS:
            missing = _missing_weights(place / part, getattr(pipeline, part))
            if missing:
                raise ValueError(f"{part} without {missing[0]} and {len(missing) - 1} other weights")
    except Exception as error:  # diffusers, transformers, safetensors and the hub's client have their own errors
        wanted, got = f"a complete {kind.__name__} of diffusers", f"none ({download_failure(error)})"
        how = _HOW_TO_GET.format(name=STABLE_AUDIO if folder else name)
        advice = f"copy it again; {how}" if folder else how
        raise EditError.expected(wanted, str(source), got=got, file=folder, name="source", advice=advice) from error
    for part in _NETWORKS:
        # By hand, for how a pipeline's precision is set changed between versions of diffusers.
        getattr(pipeline, part).to(torch.float32 if part == "vae" else dtype)
    return pipeline, name


def _downloaded(kind: Any, name: str) -> Path:
    """Return the folder of a pipeline in the hub's cache, after downloading it where it is not there."""
    try:
        return Path(kind.download(name, local_files_only=True))
    except Exception:  # not there, or not complete; the client raises whatever it does
        return Path(kind.download(name))


def _no_memory(what: str, device: torch.device) -> EditError:
    advice = "free memory, or choose the device cpu"
    return EditError.expected(f"one with memory for {what}", str(device), name="device", advice=advice)


def _missing_weights(folder: Path, network: nn.Module) -> list[str]:
    """Return the names of a network's weights that its files lack: they would be left random."""
    from safetensors import safe_open

    there: set[str] = set()
    for path in sorted(folder.glob("*.safetensors")):
        with safe_open(path, framework="pt") as file:
            there |= set(file.keys())
    held = network.state_dict(keep_vars=True)
    stored = {held[name].data_ptr() for name in there & held.keys()}
    # What shares its memory with a weight that is there is another name of it.
    return sorted(name for name, weight in held.items() if name not in there and weight.data_ptr() not in stored)


def _pipeline_class() -> Any:
    with from_extra("text", "diffusers", raising=EditError, instead="edit towards a recording"):
        from diffusers import StableAudioPipeline

        if find_spec("torchsde") is None:  # the scheduler imports it late, and its error names no remedy
            raise ImportError("no module named 'torchsde'")
    return StableAudioPipeline
