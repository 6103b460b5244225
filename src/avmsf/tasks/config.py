"""Settings of guided edits: importing this imports nothing that computes."""

import math
from dataclasses import dataclass
from typing import Final

from avmsf.errors import EditError

STABLE_AUDIO: Final = "stabilityai/stable-audio-open-1.0"
_LARGEST_SEED = 1 << 40
"""A step's own seed, a million times as large, still fits into 64 bits."""


@dataclass(frozen=True)
class SteerConfig:
    """How an edit descends."""

    steps: int = 300
    """Steps; Audio-SDS is said to take about 1,000."""
    contacts: int = 10
    """Places struck in each step, drawn anew from all over the surface."""
    modes: int = 128
    """Most modes that move by themselves, the loudest; the others follow the common factors."""
    seconds: float | None = None
    """How much of each sound is compared; as long as the field's sounds where it is not given."""
    fft_sizes: tuple[int, ...] = (2048, 1024, 512, 256)
    """Resolutions of the loss, samples at 44.1 kHz; frames are a quarter of each apart."""
    seed: int = 0
    """Of all chance: places, noise levels, noise; at most 2^40."""
    preview_every: int = 50
    """Steps between previews that can be listened to; 0 for none."""

    def __post_init__(self) -> None:
        """Raise `EditError` for values that cannot be meant."""
        for name, least in (("steps", 1), ("contacts", 1), ("modes", 1), ("preview_every", 0), ("seed", 0)):
            if getattr(self, name) < least:
                raise EditError(f"{name} = {getattr(self, name)}: expected {least} or more")
        if self.seed > _LARGEST_SEED:
            raise EditError(f"seed = {self.seed}: expected at most {_LARGEST_SEED}: choose a smaller number")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise EditError(f"seconds = {self.seconds:g}: expected more than 0")
        if not self.fft_sizes or any(size < 4 or size % 4 for size in self.fft_sizes):
            raise EditError(f"fft_sizes = {self.fft_sizes}: expected multiples of 4, such as 2048, 1024, 512, 256")
        longest = max(self.fft_sizes) / 44100
        if self.seconds is not None and self.seconds < longest:
            raise EditError(
                f"seconds = {self.seconds:g}: expected at least {longest:.2g}, what a window of {max(self.fft_sizes)} "
                "samples at 44.1 kHz hears: compare more of the sounds, or leave the largest of fft_sizes out"
            )


@dataclass(frozen=True)
class DistillationConfig:
    """How targets are drawn from a model."""

    guidance: float = 15.0
    """How many times the step from the negative words, or from none, to the prompt is taken; Audio-SDS is said to have
    gone up to 60."""
    denoising: int = 4
    """Partial denoising steps for a target, 2 to 10."""
    lowest: float = 0.025
    """Least noise level that a target begins at, above 0."""
    highest: float = 0.875
    """Greatest noise level that a target begins at, below 1."""
    batch: int = 10
    """Sounds that the model is given at once; halved where memory runs out."""

    def __post_init__(self) -> None:
        """Raise `EditError` for values that cannot be meant."""
        if not 0 < self.lowest <= self.highest < 1:
            raise EditError(f"noise levels {self.lowest:g} to {self.highest:g}: expected 0 < lowest <= highest < 1")
        for name in ("denoising", "batch"):
            if getattr(self, name) < 1:
                raise EditError(f"{name} = {getattr(self, name)}: expected 1 or more")
        if not (self.guidance >= 0 and math.isfinite(self.guidance)):
            raise EditError(f"guidance = {self.guidance:g}: expected a number that is not negative, such as 15")
