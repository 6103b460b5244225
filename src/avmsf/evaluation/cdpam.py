"""CDPAM: how different two sounds are perceived, by a network trained on listeners' answers.

Manocha, Jin, Zhang and Finkelstein, "CDPAM: Contrastive learning for perceptual audio similarity", ICASSP 2021; the
network and its weights are those of their package `cdpam`, at 22,050 Hz. It is not free of level: sounds are fractions
of full scale, -1 to 1. The ObjectFolder benchmark calls it so, and values near 1e-4, as the paper has them, come about
in no other way [inferred], although the network was trained on 16-bit integers.
"""

import hashlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.nn.functional import conv1d, leaky_relu, normalize

from avmsf.errors import EvaluationError
from avmsf.evaluation.metrics import PerContact, validate, validate_sounds
from avmsf.modal.spectra import resampled

SAMPLE_RATE = 22050.0
"""Hz that sounds are resampled to (polyphase)."""
_LAYERS = 16
"""Convolutions of the encoder; every fourth keeps every second sample and has twice as many channels."""
_TAPS = 15
_HEAD_LAYERS = 4
"""Layers of the distance."""
_NORM_EPSILON = 1e-5
"""What batch normalization adds to a variance."""
_SLOPE, _HEAD_SLOPE = 0.1, 0.01
"""Slopes of the rectifiers below zero, in the encoder and in the distance."""
_SILENCE = 1024
"""Samples of silence in whose middle, after all layers, the ends are not felt: they reach 27 of 64."""
_FILE = Path("CDPAM_trained", "scratchJNDdefault_best_model.pth")
_DIGEST = "453c8b6edee1a94f0120236156436ff28fe4d8d884485e4a67695c8e8570bdfe"
"""SHA-256 of the weights of cdpam 0.0.6: a pickle of Python 2, which torch opens in no way that runs no code."""


def find_weights() -> Path:
    """Return where the installed package keeps its weights. Raises EvaluationError where it is not installed."""
    # Importing the package would fail: it needs modules that it does not install, and names that numpy has dropped.
    found = importlib.util.find_spec("cdpam")
    if found is None or not found.submodule_search_locations:
        advice = "pip install 'avmsf[eval]', or omit CDPAM with --no-cdpam"
        raise EvaluationError.expected("an installed package", name="cdpam", advice=advice)
    return Path(found.submodule_search_locations[0]) / _FILE


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Return the authors' trained weights, by their names in their code. Raises EvaluationError for any other file."""
    try:
        found = "other content" if hashlib.sha256(path.read_bytes()).hexdigest() != _DIGEST else ""
    except OSError as error:
        found = str(error)
    if found:
        advice = "install them again: pip install --force-reinstall 'cdpam==0.0.6'"
        raise EvaluationError.expected("the trained weights of CDPAM", got=found, file=path, advice=advice)
    weights: Mapping[str, Tensor] = torch.load(path, map_location="cpu", weights_only=False)["state"]
    return weights


@dataclass(frozen=True, eq=False)
class Cdpam:
    """The encoder with its batch normalization folded in, and the layers of the distance; `Cdpam.load()` makes one.

    Sixteen convolutions, each followed by a leaky rectifier. Of the mean over time the first half, the authors'
    acoustic part, is scaled to length one. The distance sums weighted absolute differences after each of four layers,
    so that of features that are weighted beforehand it is the L1 distance: each sound is embedded once, however many
    others it is compared with.

    What passes through the encoder is the difference from its response to silence. Sounds as fractions of full scale
    change that response by so little that the rounding of 32-bit sums would be a part of the distance.
    """

    convolutions: tuple[tuple[Float[Tensor, "_ _ _"], Float[Tensor, "_ 1"]], ...]
    """Of each layer of the encoder: weights [outputs, inputs, taps] and bias [outputs, 1]."""
    head_layers: tuple[tuple[Float64[Tensor, "_ _"], Float64[Tensor, " _"], Float64[Tensor, " _"]], ...]
    """Of each layer of the distance: weights, bias, and what its differences are multiplied by."""
    _silences: dict[int, tuple[Float[Tensor, "_ _"], ...]] = field(default_factory=dict, repr=False)
    _embeddings: dict[str, Float64[Tensor, " features"]] = field(default_factory=dict, repr=False)

    @classmethod
    def load(cls) -> "Cdpam":
        """Read the installed package's weights.

        Raises EvaluationError where the package is missing or its weights are not those known here.
        """
        weights = read_weights(find_weights())
        head_layers = tuple(
            (
                weights[f"model_dist.convs.{layer}.0.weight"].double(),
                weights[f"model_dist.convs.{layer}.0.bias"].double(),
                weights[f"model_dist.chan_w.{layer}"].double().abs(),
            )
            for layer in range(_HEAD_LAYERS)
        )
        return cls(tuple(_folded(weights, layer) for layer in range(_LAYERS)), head_layers)

    def distance(
        self, predicted: Float[Tensor, "..."], truth: Float[Tensor, "..."], *, sample_rate: float
    ) -> PerContact:
        """Return each contact's distance; sounds are fractions of full scale. Raises as `validate` and `embed`."""
        validate(predicted, truth)
        embeddings = [self.embed(sounds, sample_rate=sample_rate) for sounds in (predicted, truth)]
        return (embeddings[0] - embeddings[1]).abs().sum(dim=1)

    def embed(self, sounds: Float[Tensor, "..."], *, sample_rate: float) -> Float64[Tensor, "contacts features"]:
        """Return the features that the distance compares; they are cached by the sounds' samples.

        Sounds [contacts, samples] are fractions of full scale. Raises EvaluationError for sounds that are empty or not
        finite, and for a rate that is not positive.
        """
        validate_sounds(sounds, sample_rate=sample_rate, wanted=SAMPLE_RATE)
        rows = []
        for sound in sounds.detach().cpu().double():
            key = hashlib.sha256(f"{float(sample_rate)!r} ".encode() + sound.numpy().tobytes()).hexdigest()
            if key not in self._embeddings:
                self._embeddings[key] = self._computed(sound, sample_rate)
            rows.append(self._embeddings[key])
        return torch.stack(rows)

    def _computed(self, sound: Float64[Tensor, " samples"], sample_rate: float) -> Float64[Tensor, " features"]:
        scaled = resampled(sound[None], sample_rate=sample_rate, wanted=SAMPLE_RATE)[0]
        with torch.no_grad():
            features = self._features(scaled.float())
        if not bool(torch.isfinite(features).all()):
            raise EvaluationError.expected("fractions of full scale, 1", float(sound.abs().max()), name="sounds")
        return features

    def _features(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " features"]:
        """Return the weighted features of a sound of any length at 22,050 Hz, float32."""
        difference, mean = sound[None], torch.zeros(1)
        silences = self._silence(len(sound))
        for layer, silence in enumerate(silences):
            difference = conv1d(difference, self.convolutions[layer][0], stride=_stride(layer), padding=_TAPS // 2)
            level = _lengthened(silence, difference.shape[1])
            # While the sum keeps the level's sign, its slope is the level's; beyond zero it is the other one.
            sign = torch.where(level > 0.0, 1.0, -1.0)
            beyond = torch.addcmul(-level.abs(), -sign, difference).relu_()
            difference = difference * torch.where(level > 0.0, 1.0, _SLOPE) + (1 - _SLOPE) * beyond
            mean = leaky_relu(level.double(), _SLOPE).mean(dim=1) if layer == _LAYERS - 1 else mean
        return self._head(mean + difference.mean(dim=1, dtype=torch.float64))

    def _head(self, mean: Float64[Tensor, " dim"]) -> Float64[Tensor, " features"]:
        """Return the weighted features of an encoder's mean over time."""
        values = normalize(mean, dim=0)
        features = []
        for number, (matrix, offset, importance) in enumerate(self.head_layers, start=1):
            values = matrix @ values + offset
            # The last layer has no rectifier.
            if number < len(self.head_layers):
                values = leaky_relu(values, _HEAD_SLOPE)
            features.append(importance * values)
        return torch.cat(features)

    def _silence(self, samples: int) -> tuple[Float[Tensor, "outputs samples"], ...]:
        """Return every convolution's response to a silence, which is shorter where its middle is constant."""
        # The strides halve the length four times; the ends look alike for lengths with the same remainder.
        length = samples if samples < _SILENCE else _SILENCE + (samples - _SILENCE) % 16
        if length not in self._silences:
            signal, responses = torch.zeros(1, length), []
            for layer, (weights, bias) in enumerate(self.convolutions):
                responses.append(conv1d(signal, weights, stride=_stride(layer), padding=_TAPS // 2) + bias)
                signal = leaky_relu(responses[-1], _SLOPE)
            self._silences[length] = tuple(responses)
        return self._silences[length]


def _stride(layer: int) -> int:
    return 2 if layer % 4 == 3 else 1


def _lengthened(response: Float[Tensor, "outputs short"], samples: int) -> Float[Tensor, "outputs samples"]:
    """Return a short silence's response as that of a longer one: its middle is repeated."""
    half, added = response.shape[1] // 2, samples - response.shape[1]
    middle = response[:, half : half + 1].expand(-1, added)
    return torch.cat([response[:, :half], middle, response[:, half:]], dim=1)


def _folded(
    weights: Mapping[str, Tensor], layer: int
) -> tuple[Float[Tensor, "outputs inputs taps"], Float[Tensor, "outputs 1"]]:
    """Return a convolution's weights and bias, batch normalization included."""
    kernel, bias = (weights[f"base_encoder.encoder.{layer}.{name}"].double() for name in ("weight", "bias"))
    scale, shift, mean, variance = (
        weights[f"base_encoder.ebatch.{layer}.{name}"].double()
        for name in ("weight", "bias", "running_mean", "running_var")
    )
    factor = scale / (variance + _NORM_EPSILON).sqrt()
    kernel, bias = kernel * factor[:, None, None], (bias - mean) * factor + shift
    # The second half of the last layer is the content part, which the distance does not use.
    used = len(bias) // 2 if layer == _LAYERS - 1 else len(bias)
    return kernel[:used].float(), bias[:used, None].float()
