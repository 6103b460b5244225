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
        longest = max(self.fft_sizes, default=0) / 44100
        _check(
            self,
            steps=(self.steps >= 1, "1 or more"),
            contacts_per_step=(self.contacts_per_step >= 1, "1 or more"),
            free_modes=(self.free_modes >= 1, "1 or more"),
            preview_every=(self.preview_every >= 0, "0 or more"),
            seed=(0 <= self.seed <= _LARGEST_SEED, f"0 to {_LARGEST_SEED}"),
            fft_sizes=(
                bool(self.fft_sizes) and not any(size < 4 or size % 4 for size in self.fft_sizes),
                "multiples of 4, such as 2048, 1024, 512, 256",
            ),
            seconds=(
                self.seconds is None or longest <= self.seconds < math.inf,
                f"finite, at least {longest:.2g}, the largest of fft_sizes at 44.1 kHz, or smaller fft_sizes",
            ),
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
        _check(
            self,
            lowest=(0 < self.lowest < 1, "above 0 and below 1"),
            highest=(self.lowest <= self.highest < 1, f"lowest, {self.lowest:g}, or more, and below 1"),
            denoising=(self.denoising >= 1, "1 or more"),
            batch=(self.batch >= 1, "1 or more"),
            guidance=(self.guidance >= 0 and math.isfinite(self.guidance), "0 or more, such as 15"),
        )


def _check(settings: object, **rules: tuple[bool, str]) -> None:
    """Raise `EditError` for the first setting whose rule, and what it expects, does not hold."""
    for name, (holds, expected) in rules.items():
        if not holds:
            raise EditError.expected(expected, getattr(settings, name), name=name)


def check_prompt(prompt: str) -> str:
    """Return a prompt without surrounding blanks. Raises `EditError` for an empty one."""
    if not prompt.strip():
        raise EditError.expected('a text, such as "an impact on a wooden bowl"', prompt, name="prompt")
    return prompt.strip()
