"""Targets from a text prompt: add noise to a sound, let a text-to-audio diffusion model denoise it.

Noise level t from 0 to 1 turns latents z by the angle a = pi t / 2: z_t = cos(a) z + sin(a) noise. A deterministic
(DDIM) step estimates the clean latents and the noise from z_t and puts them together again at a lower level; partial
denoising starts at a random level in the middle, so that much of the rendered sound stays. No gradient passes through
the model: the decoded result is a target like a recording.
"""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.editing.config import DistillationConfig, check_prompt
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.editing.stable_audio import Latents, StableAudio
from avmsf.errors import EditError
from avmsf.modal.spectra import Sounds, levelled, resampled, with_length


def noised(clean: Latents, noise: Latents, level: Float[Tensor, " contacts"]) -> Latents:
    """Return cos(a) clean + sin(a) noise, a = pi level / 2."""
    angle = (0.5 * math.pi * level)[:, None, None]
    return torch.cos(angle) * clean + torch.sin(angle) * noise


def partial_denoising(
    model: StableAudio,
    noisy: Latents,
    level: Float[Tensor, " contacts"],
    conditioning: Any,
    *,
    steps: int,
    guidance: float,
) -> Latents:
    """Return clean latents by deterministic (DDIM) steps from `level`, one a contact, down to 0 in equal parts."""
    clean = noisy
    for step in range(steps):
        above, below = level * (1 - step / steps), level * (1 - (step + 1) / steps)
        angle = (0.5 * math.pi * above)[:, None, None]
        clean = model.denoised(noisy, above, conditioning, guidance=guidance)
        noisy = noised(clean, (noisy - torch.cos(angle) * clean) / torch.sin(angle), below)
    return clean


class DecoderDistillation:
    """A guide towards a prompt (Audio-SDS's decoder variant with partial multi-step denoising)."""

    def __init__(
        self, model: StableAudio, prompt: str, *, sample_rate: float, config: DistillationConfig | None = None
    ) -> None:
        """Set a prompt for sounds of `sample_rate` Hz, that of the field. Raises `EditError` for an empty prompt."""
        self.model, self.prompt, self.sample_rate = model, check_prompt(prompt), sample_rate
        self.config = DistillationConfig() if config is None else config
        self._conditioning: tuple[int, Any] | None = None

    def describe(self) -> dict[str, Any]:
        """Return its identifying settings, as plain values."""
        return {
            "prompt": self.prompt,
            "model": self.model.name,
            **self.model.describe(),
            "guidance": self.config.guidance,
            "denoising_steps": self.config.denoising,
            "noise_levels": [self.config.lowest, self.config.highest],
        }

    def start(self, rendered: FieldAtContacts) -> ModalEdit:
        """Return the field as it is: Audio-SDS starts from the object's own sound."""
        return ModalEdit.none(rendered.field.bank)

    def targets(self, sounds: Sounds, step: int, generator: torch.Generator) -> Sounds:
        """Return the model's denoised versions of rendered sounds, at their level; failed rows are not finite.

        Raises `EditError` where a batch does not fit into the memory, and for sounds too long for the model.
        """
        with torch.no_grad():
            clips = resampled(sounds, sample_rate=self.sample_rate, wanted=self.model.sample_rate)
            lowest, highest = self.config.lowest, self.config.highest
            level = lowest + (highest - lowest) * torch.rand(len(sounds), generator=generator)
            # One seed a sound, so that the noise depends neither on the batch nor on the device.
            seeds = torch.randint(1 << 62, (len(sounds),), generator=generator).tolist()
            size, made = self.config.batch, list[Tensor]()
            try:
                for begin in range(0, len(sounds), size):
                    rows = slice(begin, begin + size)
                    made.append(self._cleaned(clips[rows], level[rows], seeds[rows]))
            except torch.OutOfMemoryError as error:
                wanted = f"memory on {self.model.device} for {size} sounds of {self.model.name} at once"
                advice = "lower prompt.distillation.batch, use fewer seconds, or choose the device cpu"
                raise EditError.expected(wanted, size, got="too little", name="batch", advice=advice) from error
            back = resampled(torch.cat(made), sample_rate=self.model.sample_rate, wanted=self.sample_rate)
            return levelled(with_length(back.to(sounds), sounds.shape[1]), sounds, sample_rate=self.sample_rate)

    def _cleaned(
        self, clips: Float[Tensor, "batch samples"], level: Float[Tensor, " batch"], seeds: list[int]
    ) -> Float[Tensor, "batch samples"]:
        model, samples = self.model, clips.shape[1]
        if self._conditioning is None or self._conditioning[0] != samples:
            words = model.embed(self.prompt, seconds=samples / model.sample_rate)
            self._conditioning = (samples, words)
        # The model was trained on audio at full scale: the peak becomes .5.
        peak = clips.abs().amax(dim=1, keepdim=True).clamp_min(torch.finfo(clips.dtype).tiny)
        waveforms = (0.5 * clips / peak)[:, None].expand(-1, model.channels, -1).to(model.device)
        latents = model.encode(waveforms)
        draws = [torch.randn(latents.shape[1:], generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        level = level.to(latents)
        clean = partial_denoising(
            model,
            noised(latents, torch.stack(draws).to(latents), level),
            level,
            self._conditioning[1],
            steps=self.config.denoising,
            guidance=self.config.guidance,
        )
        return model.decode(clean, samples=samples).mean(dim=1).float().cpu()
