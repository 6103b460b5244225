"""CLAP score: how well a sound fits a text prompt, by a network trained on captioned recordings (extra `eval`).

The score is the cosine of the sound's and the words' embeddings, -1 to 1, higher is better; the paper gives it without
a convention, and without the network's name. Here: sounds are resampled to the network's own rate, 48 kHz for all that
are published, scaled to a peak of one, which makes the score free of level, and cut to the network's longest clip, 10 s
from the onset on. Nothing is drawn by chance: the feature extractor of transformers cuts longer clips at random, and of
a fused network's clips declares one at random to be long; ours are cut beforehand, and none of them is long. Shorter
sounds are repeated as the extractor's own settings have it, which is how the networks were trained."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from avmsf._utils.files import write_whole
from avmsf._utils.hub import HUB_SECONDS, is_hub_name, read_settings, why_not
from avmsf.errors import EvaluationError
from avmsf.evaluation.metrics import PerContact, resampled, validate_sounds

MODELS: Final = ("laion/clap-htsat-unfused", "laion/clap-htsat-fused", "laion/larger_clap_general")
"""Names under which the hub has networks that fit."""
_CONFIG, _EXTRACTOR = "config.json", "preprocessor_config.json"
_EXTRACTORS = (_EXTRACTOR, "processor_config.json")
"""Either holds the feature extractor's settings; which one depends on the transformers that wrote the folder."""
_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
"""Either will do."""


def find_clap(source: str | Path) -> Path:
    """Return the folder that holds a network: `source` itself, or what the hub has under this name.

    Raises EvaluationError where there is no such folder or model, and where it cannot be downloaded.
    """
    folder = Path(source).expanduser()
    if folder.is_dir():
        return folder
    name = str(source)
    if not is_hub_name(source):
        raise EvaluationError.expected(
            f"a folder with a CLAP model, or a name such as {', '.join(MODELS)}",
            name,
            got="no such folder",
            file=folder,
            name="source",
            advice="check the path",
        )
    return _from_hub(name)


def transformers_clap(folder: Path) -> tuple[nn.Module, Any, str]:
    """Load a folder's `ClapModel` and `ClapProcessor`; return them and a digest of what decides embeddings.

    Raises EvaluationError where transformers is missing, and for a folder that holds another model or a part of one.
    """
    transformers = _transformers()
    weights = _expect_clap(folder)
    try:
        model, report = transformers.ClapModel.from_pretrained(folder, local_files_only=True, output_loading_info=True)
        processor = transformers.ClapProcessor.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # whatever is wrong with a file, transformers and safetensors have their own errors
        raise EvaluationError(
            f"{folder}: expected a CLAP model, got files that cannot be loaded ({error}); copy them again", file=folder
        ) from error
    # Any weight that is not there would be left random.
    missing = sorted(name for name in report["missing_keys"] if not name.endswith("position_ids"))
    if missing:
        raise EvaluationError(
            f"{weights}: expected all weights of the model, {len(missing)} are missing such as {missing[0]}; copy it "
            f"and {_CONFIG} from one model",
            file=weights,
            name="weights",
            value=tuple(missing),
        )
    digest = hashlib.sha256()
    for path in (folder / _CONFIG, *(folder / name for name in _EXTRACTORS if (folder / name).is_file()), weights):
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return model, processor, digest.hexdigest()


def _expect_clap(folder: Path) -> Path:
    """Return the file of a folder's weights. Raises EvaluationError unless it holds a CLAP model."""
    if (folder / "model_index.json").is_file():
        kind = read_settings(folder / "model_index.json", raising=EvaluationError).get("_class_name")
        raise EvaluationError(
            f"{folder}: expected a CLAP model, got a pipeline of diffusers, {kind}; give a model such as {MODELS[0]}",
            file=folder,
            name="_class_name",
            value=kind,
        )
    lacking = [] if (folder / _CONFIG).is_file() else [_CONFIG]
    if not lacking:
        kind = read_settings(folder / _CONFIG, raising=EvaluationError).get("model_type")
        if kind != "clap":
            raise EvaluationError.expected(
                "a model of type 'clap' (ClapModel)", kind, file=folder / _CONFIG, name="model_type"
            )
    lacking += [
        " or ".join(each) for each in (_EXTRACTORS, _WEIGHTS) if not any((folder / name).is_file() for name in each)
    ]
    if lacking:
        raise EvaluationError.expected(
            "a CLAP model",
            tuple(lacking),
            got=f"none of its {' and '.join(lacking)}",
            file=folder,
            advice=_how_to_download(MODELS[0]),
        )
    return next(folder / name for name in _WEIGHTS if (folder / name).is_file())


def _from_hub(name: str) -> Path:
    """Return the folder of a model in the hub's cache, after downloading it where it is not there."""
    _transformers()
    from huggingface_hub import snapshot_download

    settings = ["*.json", "*.txt"]
    try:
        kept = Path(snapshot_download(name, allow_patterns=settings, local_files_only=True))
        if any((kept / weights).is_file() for weights in _WEIGHTS):
            return kept
    except Exception:  # not in the cache: the hub's client has an error of its own for each way of not being there
        pass
    try:
        for weights in _WEIGHTS:
            folder = Path(snapshot_download(name, allow_patterns=[*settings, weights], etag_timeout=HUB_SECONDS))
            if (folder / weights).is_file():
                return folder
        raise FileNotFoundError(f"no {' and no '.join(_WEIGHTS)}")
    except Exception as error:  # the hub's client raises whatever the network beneath it does
        raise EvaluationError(
            f"{name}: expected its weights, got none: they could not be downloaded ({why_not(error)}); "
            f"{_how_to_download(name)}",
            name="source",
            value=name,
        ) from error


def _how_to_download(name: str) -> str:
    return (
        f"on a computer with a network run hf download {name} --local-dir FOLDER, copy FOLDER here, and give its path"
    )


def _transformers() -> Any:
    try:
        import transformers
        from transformers import ClapModel, ClapProcessor  # noqa: F401
    except (ImportError, RuntimeError) as error:  # RuntimeError: one of its own optional packages is broken
        raise EvaluationError(
            f"CLAP score: expected the package transformers, got {error}; pip install 'avmsf[eval]'",
            name="transformers",
        ) from error
    return transformers


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
