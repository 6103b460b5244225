"""The network of CDPAM, from a sound to the features in which the distance of two sounds is a sum of differences."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.evaluation.cdpam_weights import LAYERS, CdpamWeights
from avmsf.evaluation.convolution import TiledConvolution, Workspace

FEATURES = 256 + 64 + 16 + 4
"""Numbers in which two sounds are compared: those of all layers of the distance."""
_TAPS = 15
_NORM_FLOOR = 1e-5
"""What batch normalization adds to a variance."""
_LEAK, _HEAD_LEAK = 0.1, 0.01
"""Slopes of the rectifiers below zero, in the encoder and in the distance."""
_SILENCE = 1024
"""Samples of silence in whose middle, after all layers, the ends are not felt: they reach 27 of 64."""
_TILES = {1: 48, 2: 32}
"""Samples a tile, by stride. Longer ones need fewer products and more memory; see docs/decisions/cdpam.md."""


@dataclass(frozen=True, eq=False)
class Silence:
    """What a convolution makes of silence: one value a channel, but near the ends, where the padding is felt."""

    left: Float[Tensor, "outputs left"]
    middle: Float[Tensor, "outputs 1"]
    right: Float[Tensor, "outputs right"]

    @classmethod
    def of(cls, response: Float[Tensor, "outputs samples"]) -> "Silence":
        """Cut a short silence's response in the middle."""
        half = response.shape[1] // 2
        return cls(response[:, :half], response[:, half : half + 1], response[:, half + 1 :])

    def rectify(self, difference: Float[Tensor, "outputs samples"]) -> Float[Tensor, "outputs samples"]:
        """Return what the leaky rectifier makes of silence and a difference from it, less what it makes of silence."""
        changed = torch.empty_like(difference)
        end = difference.shape[1] - self.right.shape[1]
        pieces = (slice(0, self.left.shape[1]), slice(self.left.shape[1], end), slice(end, None))
        for piece, level in zip(pieces, (self.left, self.middle, self.right), strict=True):
            # While the sum keeps the level's sign the slope is the level's; beyond zero the other one.
            sign = torch.where(level > 0.0, 1.0, -1.0)
            beyond = torch.addcmul(-level.abs(), -sign, difference[:, piece]).relu_()
            slope = torch.where(level > 0.0, 1.0, _LEAK)
            torch.mul(difference[:, piece], slope, out=changed[:, piece]).add_(beyond, alpha=1 - _LEAK)
        return changed

    def mean(self, samples: int) -> Float64[Tensor, " outputs"]:
        """Return the mean over time of what the leaky rectifier makes of a silence of so many samples."""
        ends = torch.cat([self.left, self.right], dim=1)
        middle = samples - ends.shape[1]
        total = _leaky(ends.double()).sum(dim=1) + middle * _leaky(self.middle.double())[:, 0]
        return total / samples


@dataclass(frozen=True, eq=False)
class CdpamNetwork:
    """The encoder with its batch normalization folded in, and the layers of the distance.

    Sixteen convolutions, each followed by a leaky rectifier; every fourth keeps every second sample and has twice as
    many channels. Of the mean over time the first half, the authors' acoustic part, is scaled to length one. The
    distance sums weighted absolute differences after each of four layers, so that of features that are weighted
    beforehand it is the plain sum: an L1 distance, which is symmetric and obeys the triangle inequality.

    What passes through the encoder is the difference from its response to silence. Sounds as fractions of full scale
    change that response by so little that the rounding of 32-bit sums would be a part of the distance.
    """

    first: Float[Tensor, "_ 1 taps"]
    """The first convolution, of a single channel."""
    others: tuple[TiledConvolution, ...]
    biases: tuple[Float[Tensor, "_ 1"], ...]
    """Of all convolutions."""
    layers: tuple[tuple[Float64[Tensor, "_ _"], Float64[Tensor, " _"], Float64[Tensor, " _"]], ...]
    """Of each layer of the distance: weights, bias, and what its differences are multiplied by."""
    _silences: dict[int, tuple[Silence, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, weights: CdpamWeights) -> "CdpamNetwork":
        """Fold and arrange trained weights. Raises EvaluationError where they are not those of this network."""
        first, *others = (_fold(weights, layer) for layer in range(LAYERS))
        strides = [2 if layer % 4 == 3 else 1 for layer in range(1, LAYERS)]
        convolutions = tuple(
            TiledConvolution.of(kernel, stride=stride, tile=_TILES[stride])
            for (kernel, _), stride in zip(others, strides, strict=True)
        )
        sizes = (512, 256, 64, 16, 4)
        layers = tuple(
            (
                weights.take(f"model_dist.convs.{layer}.0.weight", sizes[layer + 1], sizes[layer]),
                weights.take(f"model_dist.convs.{layer}.0.bias", sizes[layer + 1]),
                weights.take(f"model_dist.chan_w.{layer}", sizes[layer + 1]).abs(),
            )
            for layer in range(4)
        )
        biases = tuple(bias.float()[:, None] for _, bias in (first, *others))
        return cls(first[0].float(), convolutions, biases, layers)

    def features(self, sound: Float[Tensor, " samples"], workspace: Workspace) -> Float64[Tensor, " features"]:
        """Return the weighted features of a sound of any length at 22,050 Hz, float32."""
        silence, *silences = self._silence(len(sound), workspace)
        difference = silence.rectify(torch.nn.functional.conv1d(sound[None], self.first, padding=_TAPS // 2))
        for convolution, level in zip(self.others, silences, strict=True):
            difference = level.rectify(convolution(difference, workspace))
        mean = difference.mean(dim=1, dtype=torch.float64) + silences[-1].mean(difference.shape[1])
        return self.head(mean)

    def head(self, mean: Float64[Tensor, " dim"]) -> Float64[Tensor, " features"]:
        """Return the weighted features of an encoder's mean over time."""
        values = torch.nn.functional.normalize(mean, dim=0)
        features = []
        for number, (matrix, offset, importance) in enumerate(self.layers, start=1):
            values = matrix @ values + offset
            # The last layer has no rectifier.
            if number < len(self.layers):
                values = torch.nn.functional.leaky_relu(values, _HEAD_LEAK)
            features.append(importance * values)
        return torch.cat(features)

    def _silence(self, samples: int, workspace: Workspace) -> tuple[Silence, ...]:
        """Return every convolution's response to a silence of so many samples."""
        # The strides halve the length four times; the ends look alike for lengths with the same remainder.
        length = samples if samples < _SILENCE else _SILENCE + (samples - _SILENCE) % 16
        if length not in self._silences:
            responses = [self.biases[0].expand(-1, length)]
            for convolution, bias in zip(self.others, self.biases[1:], strict=True):
                responses.append(convolution(_leaky(responses[-1]), workspace) + bias)
            self._silences[length] = tuple(Silence.of(response) for response in responses)
        return self._silences[length]


def _leaky(values: Float[Tensor, "outputs samples"]) -> Float[Tensor, "outputs samples"]:
    return torch.nn.functional.leaky_relu(values, _LEAK)


def _channels(layer: int) -> int:
    """Return how many channels a layer of the encoder makes."""
    return int(64 * 2 ** ((layer + 1) // 4))


def _fold(
    weights: CdpamWeights, layer: int
) -> tuple[Float64[Tensor, "outputs inputs taps"], Float64[Tensor, " outputs"]]:
    """Return a convolution's weights and bias, batch normalization included."""
    outputs, inputs = _channels(layer), 1 if layer == 0 else _channels(layer - 1)
    kernel = weights.take(f"base_encoder.encoder.{layer}.weight", outputs, inputs, _TAPS)
    bias = weights.take(f"base_encoder.encoder.{layer}.bias", outputs)
    scale, shift, mean, variance = (
        weights.take(f"base_encoder.ebatch.{layer}.{name}", outputs)
        for name in ("weight", "bias", "running_mean", "running_var")
    )
    factor = scale / (variance + _NORM_FLOOR).sqrt()
    kernel, bias = kernel * factor[:, None, None], (bias - mean) * factor + shift
    if layer == LAYERS - 1:
        # The second half is the content part, in which the distance takes no interest.
        kernel, bias = kernel[: outputs // 2], bias[: outputs // 2]
    return kernel, bias
