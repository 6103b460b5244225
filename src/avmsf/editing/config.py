"""Settings of guided edits: importing this imports nothing that computes."""

import math
from dataclasses import dataclass
from typing import Final

from avmsf.errors import EditError

STABLE_AUDIO: Final = "stabilityai/stable-audio-open-1.0"
_LARGEST_SEED = 1 << 40
"""A step's own seed, a million times as large, still fits into 64 bits."""


@dataclass(frozen=True)
class GuidedEditConfig:
    """Optimization of a guided edit."""

    steps: int = 300
    """Steps; Audio-SDS reports about 1,000."""
    contacts_per_step: int = 10
    """Contacts of each step, drawn again from the whole surface."""
    free_modes: int = 128
    """Number of modes, the loudest, with own factors; the others follow the common factors."""
    seconds: float | None = None
    """Duration of each sound that is compared; by default that of the field's sounds."""
    fft_sizes: tuple[int, ...] = (2048, 1024, 512, 256)
    """Resolutions of the loss, samples at 44.1 kHz; frames are a quarter of each apart."""
    seed: int = 0
    """Random seed of contacts, noise levels and noise; at most 2^40."""
    preview_every: int = 50
    """Steps between preview sounds; 0 for none."""

    def __post_init__(self) -> None:
        """Raise `EditError` for values out of range."""
        for name, least in (
            ("steps", 1),
            ("contacts_per_step", 1),
            ("free_modes", 1),
            ("preview_every", 0),
            ("seed", 0),
        ):
            if getattr(self, name) < least:
                raise _unfit(self, name, f"{least} or more")
        if self.seed > _LARGEST_SEED:
            raise _unfit(self, "seed", f"at most {_LARGEST_SEED}")
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise _unfit(self, "seconds", "more than 0")
        if not self.fft_sizes or any(size < 4 or size % 4 for size in self.fft_sizes):
            raise _unfit(self, "fft_sizes", "multiples of 4, such as 2048, 1024, 512, 256")
        longest = max(self.fft_sizes) / 44100
        if self.seconds is not None and self.seconds < longest:
            raise _unfit(
                self, "seconds", f"at least {longest:.2g}, the largest of fft_sizes at 44.1 kHz, or smaller fft_sizes"
            )


@dataclass(frozen=True)
class DistillationConfig:
    """Targets from a diffusion model."""

    guidance: float = 15.0
    """Classifier-free guidance scale; Audio-SDS reports values up to 60."""
    denoising: int = 4
    """Partial denoising steps for a target, 2 to 10."""
    lowest: float = 0.025
    """Lowest initial noise level, above 0."""
    highest: float = 0.875
    """Highest initial noise level, below 1."""
    batch: int = 10
    """Sounds in one batch of the model; halved when memory runs out."""

    def __post_init__(self) -> None:
        """Raise `EditError` for values out of range."""
        if not 0 < self.lowest <= self.highest < 1:
            raise _unfit(self, "lowest" if not 0 < self.lowest < 1 else "highest", "0 < lowest <= highest < 1")
        for name in ("denoising", "batch"):
            if getattr(self, name) < 1:
                raise _unfit(self, name, "1 or more")
        if not (self.guidance >= 0 and math.isfinite(self.guidance)):
            raise _unfit(self, "guidance", "0 or more, such as 15")


def _unfit(settings: GuidedEditConfig | DistillationConfig, name: str, expected: str) -> EditError:
    value = getattr(settings, name)
    return EditError(f"{name}: expected {expected}, got {value}", name=name, value=value)


def check_prompt(prompt: str) -> str:
    """Return a prompt without surrounding blanks. Raises `EditError` for an empty one."""
    if not prompt.strip():
        raise EditError(
            'expected a prompt, such as "an impact on a wooden bowl", got an empty one', name="prompt", value=prompt
        )
    return prompt.strip()
