"""CLAP score: how well a sound fits a text prompt, by a network trained on captioned recordings (extra `eval`).

The score is the cosine of the sound's and the words' embeddings, -1 to 1, higher is better; the paper gives it without
a convention, and without the network's name. Here: sounds are resampled to the network's own rate, 48 kHz for all that
are published, scaled to a peak of one, which makes the score free of level, and cut to the network's longest clip, 10 s
from the onset on. Nothing is drawn by chance: the feature extractor of transformers cuts longer clips at random, and of
a fused network's clips declares one at random to be long; ours are cut beforehand, and none of them is long. Shorter
sounds are repeated as the extractor's own settings have it, which is how the networks were trained.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.evaluation.clap_weights import find_clap, transformers_clap
from avmsf.evaluation.metrics import PerContact, resampled, validate_sounds

DEFAULT: Final = "laion/clap-htsat-unfused"
"""The hub's name of the network that scores are taken with unless another is named."""
_BATCH = 8
"""Sounds embedded at a time: bounds the memory."""
_ARITHMETIC = "1"
"""Part of the names of kept embeddings; another number where they are computed otherwise than before."""


@dataclass(frozen=True, eq=False)
class Clap:
    """The network, and what it made of every sound and every prompt so far; `Clap.load()` makes one."""

    model: Any
    """A `ClapModel`."""
    processor: Any
    """Its `ClapProcessor`: a tokenizer and a feature extractor."""
    name: str
    """What a report calls the network."""
    digest: str
    """SHA-256 of its weights and settings, in hexadecimal."""
    folder: Path | None = None
    """Where sounds' embeddings outlive the process; any number of processes may share it. None keeps none."""
    _made: dict[str, Float[Tensor, " dim"]] = field(default_factory=dict, repr=False)

    @classmethod
    def load(
        cls, source: str | Path = DEFAULT, *, folder: Path | None = None, device: str | torch.device = "cpu"
    ) -> "Clap":
        """Load a network of the hub, or a local folder that `save_pretrained` or a download filled.

        Raises EvaluationError where transformers is missing, where the weights are neither here nor to be downloaded,
        and for a folder that holds another model or a part of one.
        """
        place = find_clap(source)
        model, processor, digest = transformers_clap(place)
        return cls(model.to(device).eval().requires_grad_(False), processor, str(source), digest, folder)

    @property
    def sample_rate(self) -> float:
        """Hz that sounds are resampled to (polyphase)."""
        return float(self.processor.feature_extractor.sampling_rate)

    def score(self, sounds: Float[Tensor, "..."], prompts: Sequence[str], *, sample_rate: float) -> PerContact:
        """Return the cosine of each sound [contacts, samples] with its prompt; one prompt alone goes with all.

        Raises EvaluationError for sounds that are empty, silent or not finite, for an empty prompt and for another
        number of prompts.
        """
        heard = self.embed(sounds, sample_rate=sample_rate)
        said = self.embed_words(prompts)
        if len(said) not in (1, len(heard)):
            raise EvaluationError(
                f"expected one prompt, or one for each of {len(heard)} sounds, got {len(said)}",
                name="prompts",
                value=len(said),
            )
        return (heard * said).sum(dim=1).clamp(-1.0, 1.0)

    def embed(self, sounds: Float[Tensor, "..."], *, sample_rate: float) -> Float64[Tensor, "contacts dim"]:
        """Return the sounds' embeddings, of length one; they are remembered by the sounds' samples and rate."""
        validate_sounds(sounds)
        heard = sounds.detach().cpu().double()
        silent = torch.nonzero(heard.abs().amax(dim=1) == 0).flatten()
        if len(silent):
            raise EvaluationError.expected("a sound", 0.0, got="silence", row=int(silent[0]), name="sounds")
        keys = [self._key(sound, sample_rate) for sound in heard]
        missing = [row for row, key in enumerate(keys) if not self._remembered(key)]
        # A sound that is there twice is embedded once.
        missing = list({keys[row]: row for row in reversed(missing)}.values())[::-1]
        for start in range(0, len(missing), _BATCH):
            rows = missing[start : start + _BATCH]
            made = self._embed_batch([self._prepared(heard[row], sample_rate) for row in rows])
            for row, embedding in zip(rows, made, strict=True):
                self._made[keys[row]] = embedding
                if self.folder is not None:
                    _keep(self.folder / f"{keys[row]}.npy", embedding)
        return _unit(torch.stack([self._made[key] for key in keys]))

    def embed_words(self, prompts: Sequence[str]) -> Float64[Tensor, "prompts dim"]:
        """Return the prompts' embeddings, of length one. Raises EvaluationError for an empty prompt."""
        if isinstance(prompts, str) or not prompts:
            raise EvaluationError(
                f"expected a list of prompts, got {prompts!r}; give one as [prompt]", name="prompts", value=prompts
            )
        return _unit(torch.stack([self._embed_prompt(prompt) for prompt in prompts]))

    def _embed_prompt(self, prompt: str) -> Float[Tensor, " dim"]:
        if not prompt.strip():
            raise EvaluationError(
                "expected a prompt, such as 'striking a wooden bowl', got an empty one", name="prompt", value=prompt
            )
        key = f"words {prompt}"
        if key not in self._made:
            # One by one: padding would make the last digits depend on the other prompts.
            tokens = self.processor.tokenizer([prompt], return_tensors="pt", truncation=True)
            device = next(self.model.parameters()).device
            with torch.inference_mode():
                words = {name: tokens[name].to(device) for name in ("input_ids", "attention_mask")}
                self._made[key] = _vector(self.model.get_text_features(**words))[0]
        return self._made[key]

    def _embed_batch(self, waveforms: list[Float64[np.ndarray, " _samples"]]) -> Float[Tensor, "contacts dim"]:
        weights = next(self.model.parameters())
        features = torch.cat([self._features(waveform) for waveform in waveforms])
        longer = torch.zeros(len(waveforms), 1, dtype=torch.bool, device=weights.device)
        with torch.inference_mode():
            found = self.model.get_audio_features(input_features=features.to(weights), is_longer=longer)
        return _vector(found)

    def _features(self, waveform: Float64[np.ndarray, " samples"]) -> Float[Tensor, "1 channels frames mels"]:
        extractor = self.processor.feature_extractor
        made = extractor(waveform, sampling_rate=extractor.sampling_rate, return_tensors="pt")
        return made["input_features"].float()

    def _prepared(self, sound: Float64[Tensor, " samples"], sample_rate: float) -> Float64[np.ndarray, " prepared"]:
        """Return a sound at the network's rate, of peak one and not longer than its longest clip."""
        heard = resampled(sound[None], sample_rate=sample_rate, wanted=self.sample_rate)[0]
        longest = int(self.processor.feature_extractor.nb_max_samples)
        cut = heard[:longest]
        return (cut / cut.abs().max().clamp_min(torch.finfo(torch.float64).tiny)).numpy()

    def _key(self, sound: Float64[Tensor, " samples"], sample_rate: float) -> str:
        what = f"{_ARITHMETIC} {self.digest} {float(sample_rate)!r} ".encode()
        return hashlib.sha256(what + sound.contiguous().numpy().tobytes()).hexdigest()

    def _remembered(self, key: str) -> bool:
        """Return whether an embedding is at hand, after looking for it in the folder."""
        if key not in self._made and self.folder is not None:
            kept = _read(self.folder / f"{key}.npy")
            if kept is not None:
                self._made[key] = kept
        return key in self._made


def _unit(embeddings: Float[Tensor, "rows dim"]) -> Float64[Tensor, "rows dim"]:
    return torch.nn.functional.normalize(embeddings.double(), dim=1)


def _vector(output: Any) -> Float[Tensor, "rows dim"]:
    """Return the projected embeddings: until transformers 4 they came as they are, since then beside the layers'."""
    found: Tensor = output if isinstance(output, Tensor) else output.pooler_output
    # An inference tensor could not be used outside of inference afterwards.
    return found.float().cpu().clone()


def _read(path: Path) -> Float[Tensor, " dim"] | None:
    """Return a kept embedding; None where there is none or it is damaged."""
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    if values.ndim != 1 or values.dtype != np.float32 or not len(values) or not np.isfinite(values).all():
        return None
    return torch.from_numpy(values)


def _keep(path: Path, embedding: Float[Tensor, " dim"]) -> None:
    def write(place: Path) -> None:
        with open(place, "wb") as file:
            np.save(file, embedding.numpy(), allow_pickle=False)

    write_whole(path, write, raising=EvaluationError)
