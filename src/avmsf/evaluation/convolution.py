"""Convolutions of many channels with filters of many taps, exact but for rounding, by a quarter of the usual products.

A tile of N samples and a filter of K taps have N - K + 1 samples in common with their circular correlation, and a
Fourier transform turns that into one product a frequency. Of two complex numbers it takes three real products instead
of four: a b = (p - q) + i (r - p - q) with p = Re a Re b, q = Im a Im b, r = (Re a + Im a)(Re b + Im b). Both steps are
linear in the tile, in the filter and in the products, so all of it is

    output = inverse @ ((forward @ tile) * (filters @ taps))

with three constant real matrices; with C channels the product becomes a C x C matrix product, and those are what a
processor does fastest. Fifteen taps on tiles of 48 cost 71 / 34 = 2.1 products a sample instead of 15, besides the two
transforms, which are independent of the number of output or input channels.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor


class Workspace:
    """Memory that convolutions share and use again: fresh pages for each would take longer than the products."""

    def __init__(self) -> None:
        self._buffers: dict[str, Float[Tensor, " numbers"]] = {}

    def take(self, name: str, *shape: int) -> Float[Tensor, "..."]:
        """Return a float32 tensor of any content, valid until the next one of this name is taken."""
        size = math.prod(shape)
        if name not in self._buffers or self._buffers[name].numel() < size:
            self._buffers[name] = torch.empty(size)
        return self._buffers[name][:size].view(shape)


@dataclass(frozen=True, eq=False)
class TiledConvolution:
    """A convolution (torch's: a correlation) of odd length, padded with zeros to keep its input's length; no bias.

    With a stride of 2 every second sample is made, the first, third and so on; the others are not computed.
    """

    forward: Float[Tensor, "products tile"]
    weights: Float[Tensor, "products outputs inputs"]
    """Of a stride of 2, `inputs` are all channels' even samples, then all channels' odd ones."""
    inverse: Float[Tensor, "products step"]
    padding: int
    """Zeros before the first sample."""
    stride: int

    @classmethod
    def of(cls, weights: Float64[Tensor, "outputs inputs taps"], *, stride: int, tile: int) -> "TiledConvolution":
        """Prepare the filters for tiles of `tile` samples, of the input if the stride is 1 and of its halves if 2."""
        padding = weights.shape[2] // 2
        if stride == 2:
            # Even taps meet one half of the samples and odd taps the other: two filters of half the length.
            even, odd = weights[:, :, 0::2], weights[:, :, 1::2]
            weights = torch.cat([even, torch.nn.functional.pad(odd, (0, even.shape[2] - odd.shape[2]))], dim=1)
        forward, filters, inverse = _matrices(weights.shape[2], tile)
        spectra = torch.einsum("pk,oik->poi", filters.float(), weights.float())
        return cls(forward.float(), spectra, inverse.float(), padding, stride)

    def __call__(
        self, signal: Float[Tensor, "inputs samples"], workspace: Workspace
    ) -> Float[Tensor, "outputs strided_samples"]:
        """Convolve; float32. The result lies in the workspace, valid until the next convolution in it."""
        samples = signal.shape[1]
        made = -(-samples // self.stride)
        products, tile = self.forward.shape
        step = self.inverse.shape[1]
        tiles = -(-made // step)
        reach = self.stride * ((tiles - 1) * step + tile)
        padded = torch.nn.functional.pad(signal, (self.padding, reach - self.padding - samples))
        if self.stride == 2:
            padded = torch.cat([padded[:, 0::2], padded[:, 1::2]])
        inputs = len(padded)
        windows = padded.unfold(1, tile, step).reshape(inputs * tiles, tile)
        spectra = torch.mm(self.forward, windows.T, out=workspace.take("spectra", products, inputs * tiles))
        outputs = self.weights.shape[1]
        mixed = torch.bmm(
            self.weights,
            spectra.view(products, inputs, tiles),
            out=workspace.take("mixed", products, outputs, tiles),
        )
        result = torch.mm(
            mixed.view(products, outputs * tiles).T, self.inverse, out=workspace.take("result", outputs * tiles, step)
        )
        return result.view(outputs, tiles * step)[:, :made]


def _matrices(
    taps: int, tile: int
) -> tuple[Float64[Tensor, "products tile"], Float64[Tensor, "products taps"], Float64[Tensor, "products step"]]:
    """Return what turns tiles, filters and products into one another, as the module's text says; `tile` is even."""
    samples = torch.arange(tile, dtype=torch.float64)
    places, offsets = samples[: tile - taps + 1], samples[:taps]
    rows: list[tuple[Tensor, Tensor, Tensor]] = []
    for frequency in range(tile // 2 + 1):
        angle = 2 * math.pi * frequency / tile
        # The correlation's spectrum is that of the tile times the conjugate of the filter's.
        real, imaginary = torch.cos(angle * samples), -torch.sin(angle * samples)
        filter_real, filter_imaginary = torch.cos(angle * offsets), torch.sin(angle * offsets)
        if frequency in (0, tile // 2):
            rows.append((real, filter_real, torch.cos(angle * places) / tile))
            continue
        # Twice, for the frequency and its mirror image.
        cosine, sine = 2 * torch.cos(angle * places) / tile, 2 * torch.sin(angle * places) / tile
        rows += [
            (real, filter_real, cosine + sine),
            (imaginary, filter_imaginary, sine - cosine),
            (real + imaginary, filter_real + filter_imaginary, -sine),
        ]
    forward, filters, inverse = (torch.stack(column) for column in zip(*rows, strict=True))
    return forward, filters, inverse
