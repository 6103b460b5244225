"""Settings of edits: importing this imports nothing that computes."""

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Final, Literal

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
    """Sounds in one batch of the model."""

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


@dataclass(frozen=True)
class MaterialSettings:
    """Constants of the new material in place of the table's, or without --to of the present material's."""

    young: float | None = None
    """Young's modulus, Pa."""
    density: float | None = None
    """Density, kg/m3."""
    poisson: float | None = None
    """Poisson's ratio; only its expected effect is printed."""
    alpha: float | None = None
    """Mass-proportional Rayleigh damping, 1/s."""
    beta: float | None = None
    """Stiffness-proportional Rayleigh damping, s."""
    law: Literal["displacement", "velocity", "acceleration", "ratio-only"] = "displacement"
    """Quantity that the recordings are proportional to, which decides the level of each mode; ratio-only is the paper's
    law, which leaves mass and size out."""

    @property
    def constants(self) -> dict[str, float]:
        """The constants that are given."""
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "law"}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class PromptSettings:
    """Targets from a text-to-audio model."""

    model_seconds: float | None = None
    """Length that the model works at; by default all that it was trained for, and time grows in proportion."""
    device: str | None = None
    """Device of the model, cpu or cuda; by default the GPU if there is one."""
    generated: Path | None = None
    """Also write the sound that the model makes from the prompt without the field to this wav file: the paper's
    baseline."""
    clap: str | None = None
    """Also compute the CLAP score of the unedited field and of every preview with this network, a folder or a name on
    the hub; needs the extra `eval`."""
    distillation: DistillationConfig = field(default_factory=DistillationConfig)
    """Targets from the model."""


@dataclass(frozen=True)
class EditSettings:
    """Settings of an edit."""

    material: MaterialSettings = field(default_factory=MaterialSettings)
    """The new material."""
    prompt: PromptSettings = field(default_factory=PromptSettings)
    """Targets from a text-to-audio model."""
    parameters: Literal["hierarchical", "published", "independent", "searched"] = "hierarchical"
    """Parameters that are optimized. hierarchical: factors on all frequencies and all dampings, then single modes, with
    a penalty. published: the paper's form, a factor on all frequencies and single modes without a penalty, gains times
    f1/f2 at the end. independent: only single modes (Audio-SDS). searched: the same after a search for common
    factors."""
    guide: GuidedEditConfig = field(default_factory=GuidedEditConfig)
    """How the modes are optimized."""

    def check_prompt(self, prompt: str) -> None:
        """Raise `EditError` for an empty prompt, and for settings that no prompt can be used with."""
        check_prompt(prompt)
        if self.prompt.clap is not None and self.guide.preview_every == 0:
            raise EditError.expected("guide.preview_every of 1 or more with it, such as 50", 0, name="prompt.clap")
        seconds = self.prompt.model_seconds
        if seconds is not None and not 0 < seconds < math.inf:
            raise EditError.expected("more than 0, such as 3", seconds, name="prompt.model_seconds")


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
