"""CLAP score: how well a sound fits a text prompt, by a network trained on captioned recordings (extra `eval`).

The score is the cosine of the sound's and the prompt's embeddings, -1 to 1, higher is better; the paper gives it
without a convention, and without the network's name. Here: sounds are resampled to the network's own rate, 48 kHz for
all that are published, scaled to a peak of one, which makes the score free of level, and cut to the network's longest
clip, 10 s from the onset on. Nothing is drawn by chance: the feature extractor of transformers cuts longer clips at
random, and of a fused network's clips declares one at random to be long; ours are cut beforehand, and none of them is
long. Shorter sounds are repeated as the extractor's own settings have it, which is how the networks were trained.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.caching import content_digest
from avmsf._utils.files import model_folder
from avmsf.editing.guided import PreviewScore
from avmsf.errors import EvaluationError, download_failure, from_extra
from avmsf.evaluation.metrics import PerContact, validate_sounds
from avmsf.modal.spectra import resampled

DEFAULT: Final = "laion/clap-htsat-unfused"
"""The hub's name of the network that scores are taken with unless another is named."""
_BATCH = 8
"""Sounds embedded at a time: bounds the memory."""


@dataclass(frozen=True, eq=False)
class Clap:
    """The network; `Clap.load()` makes one."""

    model: Any
    """A `ClapModel`."""
    processor: Any
    """Its `ClapProcessor`: a tokenizer and a feature extractor."""
    name: str
    """What a report calls the network."""

    @classmethod
    def load(cls, source: str | Path = DEFAULT) -> "Clap":
        """Load a network of the hub, or a local folder that `save_pretrained` or a download filled.

        Raises EvaluationError where transformers is missing, where the weights are neither here nor to be downloaded,
        and for a folder that holds another model or a part of one.
        """
        name, what = str(source), f"a folder with a CLAP model, or a name such as {DEFAULT}"
        folder = model_folder(source, what, raising=EvaluationError)
        with from_extra("eval", "transformers", raising=EvaluationError):
            from transformers import ClapModel, ClapProcessor
        download = f"hf download {DEFAULT if folder else name} --local-dir FOLDER"
        advice = f"on a computer with a network run {download}, copy FOLDER here, and give its path"
        try:
            loaded: Any = ClapModel.from_pretrained(folder or name, output_loading_info=True)
            (model, report), processor = loaded, ClapProcessor.from_pretrained(folder or name)
        except Exception as error:  # transformers, safetensors and the hub's client have their own errors
            got = f"none ({download_failure(error)})"
            raise EvaluationError.expected(
                "a CLAP model", name, got=got, file=folder, name="source", advice=advice
            ) from error
        # Any weight that is not there would be left random.
        missing = tuple(sorted(each for each in report["missing_keys"] if not each.endswith("position_ids")))
        if missing:
            wanted, got = "all weights of a CLAP model", f"{len(missing)} missing such as {missing[0]}"
            raise EvaluationError.expected(wanted, missing, got=got, file=folder or name, name="weights", advice=advice)
        model.eval().requires_grad_(False)
        return cls(model, processor, name)

    @property
    def sample_rate(self) -> float:
        """Hz that sounds are resampled to (polyphase)."""
        return float(self.processor.feature_extractor.sampling_rate)

    def score(self, sounds: Float[Tensor, "..."], prompt: str, *, sample_rate: float) -> PerContact:
        """Return the cosine of each sound [contacts, samples] with a prompt.

        Raises EvaluationError for sounds that are empty, silent or not finite, and for an empty prompt.
        """
        audio, text = self.embed(sounds, sample_rate=sample_rate), self.embed_prompt(prompt)
        return (audio * text).sum(dim=1).clamp(-1.0, 1.0)

    def of_previews(self, prompt: str, sample_rate: float) -> PreviewScore:
        """Return what scores the previews of an edit, at a rate in Hz, by their fit to a prompt."""

        def score(sound: Float[Tensor, " samples"]) -> float:
            return float(self.score(sound[None], prompt, sample_rate=sample_rate))

        settings, weights = self.processor.feature_extractor.to_dict(), self.model.state_dict()
        return PreviewScore(score, self.name, content_digest(settings, *weights, *weights.values()))

    def embed(self, sounds: Float[Tensor, "..."], *, sample_rate: float) -> Float64[Tensor, "contacts dim"]:
        """Return the sounds' embeddings, of length one."""
        validate_sounds(sounds, sample_rate=sample_rate, wanted=self.sample_rate)
        silent = torch.nonzero(sounds.detach().abs().amax(dim=1) == 0).flatten()
        if len(silent):
            raise EvaluationError.expected("a sound", 0.0, got="silence", row=int(silent[0]), name="sounds")
        prepared = resampled(sounds.detach().cpu().double(), sample_rate=sample_rate, wanted=self.sample_rate)
        prepared = prepared[:, : int(self.processor.feature_extractor.nb_max_samples)]
        prepared = prepared / prepared.abs().amax(dim=1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
        embeddings = [self._embedded(batch.numpy()) for batch in torch.split(prepared, _BATCH)]
        return torch.nn.functional.normalize(torch.cat(embeddings).double(), dim=1)

    def embed_prompt(self, prompt: str) -> Float64[Tensor, "1 dim"]:
        """Return a prompt's embedding, of length one. Raises EvaluationError for an empty prompt."""
        if not prompt.strip():
            raise EvaluationError.expected("words, such as 'striking a wooden bowl'", prompt, name="prompt")
        tokens = self.processor.tokenizer([prompt], return_tensors="pt", truncation=True)
        with torch.no_grad():
            made = self.model.get_text_features(**{name: tokens[name] for name in ("input_ids", "attention_mask")})
        return torch.nn.functional.normalize(_vector(made).double(), dim=1)

    def _embedded(self, waveforms: Float64[np.ndarray, "batch samples"]) -> Float[Tensor, "batch dim"]:
        extractor, weights = self.processor.feature_extractor, next(self.model.parameters())
        features = [
            extractor(waveform, sampling_rate=extractor.sampling_rate, return_tensors="pt")["input_features"]
            for waveform in waveforms
        ]
        longer = torch.zeros(len(waveforms), 1, dtype=torch.bool)
        with torch.no_grad():
            made = self.model.get_audio_features(input_features=torch.cat(features).to(weights), is_longer=longer)
        return _vector(made)


def _vector(output: Any) -> Float[Tensor, "rows dim"]:
    """Return the projected embeddings: until transformers 4 they came as they are, since then with the layers'."""
    return output.float() if isinstance(output, Tensor) else output.pooler_output.float()
