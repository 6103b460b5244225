"""Guides towards sounds that exist: recordings of another object, or sounds as a material makes them."""

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import read_recording
from avmsf.capture.blow import clipping, expect_sudden
from avmsf.capture.onset import find_second_blow
from avmsf.capture.prepare import prepare, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import AvmsfWarning, CaptureError, EditError
from avmsf.tasks.clips import lasting, levelled, resampled
from avmsf.tasks.modaledit import ModalEdit, Struck
from avmsf.tasks.startsearch import heard_spectrum, search_start

_HELD = 0.9
"""Part of half a recording's rate up to which it still holds all of a sound."""
_FADE = 0.01
"""Seconds over which a reference that ends early hands over to the sound itself."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Clips to sound like: each rendered sound is pulled towards the clip whose spectrum is nearest, at its own level.

    Where a clip ends before the sound does nothing is asked of the rest.
    """

    clips: Float[Tensor, "clips samples"]
    """From their onsets on, padded with silence to the longest."""
    lengths: tuple[int, ...]
    """Samples of each."""
    sample_rate: float
    """Hz, the field's."""
    name: str
    """What reports call it."""

    def __post_init__(self) -> None:
        if not len(self.clips) or len(self.lengths) != len(self.clips):
            raise EditError(f"expected clips and as many lengths, found {len(self.clips)} and {len(self.lengths)}")
        if not bool(torch.isfinite(self.clips).all()):
            raise EditError(f"{self.name}: expected samples that are finite numbers, found others: record it again")
        silent = [row for row, clip in enumerate(self.clips) if float(clip.abs().max()) == 0.0]
        if silent:
            raise EditError(f"{self.name}: clip {silent[0]} (counted from 0) is silent: leave it out")

    @classmethod
    def of(cls, sounds: Float[Tensor, "clips samples"], *, sample_rate: float, name: str = "reference") -> "Reference":
        """Refer to sounds at the field's rate that start at their onset, all of one length."""
        return cls(sounds.float(), (sounds.shape[1],) * len(sounds), sample_rate, name)

    @classmethod
    def read(cls, paths: str | Path | Sequence[str | Path], *, sample_rate: float) -> "Reference":
        """Read recordings of blows and bring them to the field's `sample_rate`, Hz; a folder stands for its wav files.

        Each begins at its onset and ends at a second blow; of several channels the strongest is heard. Raises
        `EditError` for what is missing, no sound file, silent, shorter than 20 ms after the onset, or never sudden
        enough to hold a blow. Warns of a second blow, of clipping, and of a rate below the field's.
        """
        found = wav_files(paths)
        clips = [read_clip(path, sample_rate=sample_rate) for path in found]
        longest = max(len(clip) for clip in clips)
        name = found[0].name if len(found) == 1 else f"{found[0].name} and {len(found) - 1} more"
        padded = torch.cat([lasting(clip[None], longest) for clip in clips])
        return cls(padded, tuple(len(clip) for clip in clips), sample_rate, name)

    def describe(self) -> dict[str, Any]:
        """Return what tells it from other guides, as plain values."""
        digest = hashlib.sha256(self.clips.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
        return {"reference": self.name, "lengths": list(self.lengths), "samples_sha256": digest}

    def start(self, struck: Struck) -> ModalEdit:
        """Return the common pitch and decay with which the field comes nearest, from a search over both."""
        return search_start(struck, self._nearest)

    def targets(
        self, sounds: Float[Tensor, "contacts samples"], step: int, generator: torch.Generator
    ) -> Float[Tensor, "contacts samples"]:
        """Return the nearest clip of each sound, which goes on as the sound itself where the clip ends."""
        targets, share = self._nearest(sounds)
        return share * targets + (1 - share) * sounds

    def _nearest(
        self, sounds: Float[Tensor, "contacts samples"]
    ) -> tuple[Float[Tensor, "contacts samples"], Float[Tensor, "contacts samples"]]:
        """Return the nearest clip of each sound, and its share in the target: 1, and falling to 0 before its end."""
        samples = sounds.shape[1]
        clips = lasting(self.clips, samples).to(sounds)
        distance = torch.cdist(heard_spectrum(sounds), heard_spectrum(clips), p=1.0)
        chosen = distance.argmin(dim=1)
        targets = levelled(clips[chosen], sounds, sample_rate=self.sample_rate)
        ends = torch.tensor(self.lengths, device=sounds.device)[chosen, None]
        fade = max(1, round(_FADE * self.sample_rate))
        share = ((ends - torch.arange(samples, device=sounds.device)) / fade).clamp(0.0, 1.0).to(sounds)
        return targets, torch.where(ends >= samples, torch.ones_like(share), share)


def wav_files(paths: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return sound files, those of folders in the order of their names. Raises `EditError` where there are none."""
    given = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    found: list[Path] = []
    for path in given:
        found += sorted(each for each in path.iterdir() if each.suffix.lower() == ".wav") if path.is_dir() else [path]
    if not found:
        raise EditError(f"{', '.join(map(str, given)) or 'no path'}: expected wav files to sound like, found none")
    return found


def read_clip(path: Path, *, sample_rate: float) -> Float[Tensor, " samples"]:
    """Return a recorded blow from its onset to the next, float32 at `sample_rate` Hz, of its strongest channel.

    Warns and raises `EditError` as `Reference.read`.
    """
    try:
        recording = read_recording(path)
        strongest = int(np.argmax(np.var(recording.channels, axis=1)))
        mono = replace(recording, channels=recording.channels[strongest : strongest + 1])
        prepared = prepare(mono, CaptureSettings())
        expect_sudden(mono.response(), sample_rate=mono.sample_rate, name=mono.name)
    except CaptureError as error:
        raise EditError(f"the reference cannot be used: {error}") from error
    sound, rate = prepared.sound, mono.sample_rate
    notes = [clipping(mono.response(), name=mono.name)]
    second = find_second_blow(sound, 0, sample_rate=rate, seconds=len(sound) / rate)
    if second is not None:
        notes.append(
            f"{mono.name} holds more than one blow, at {prepared.onset / rate:.3f} s and at "
            f"{(prepared.onset + second) / rate:.3f} s: only the first is taken; give the others in files of their own"
        )
        sound = sound[: max(second, shortest_allowed(rate))]
    if rate < sample_rate:
        notes.append(
            f"{mono.name} is at {rate:g} Hz and holds sound up to {_HELD * 0.5 * rate:.4g} Hz: what the object has "
            f"above that is led towards silence; record at {sample_rate:g} Hz"
        )
    for note in filter(None, notes):
        warnings.warn(note, AvmsfWarning, stacklevel=2)
    clip = torch.from_numpy(np.ascontiguousarray(sound - sound.mean()))[None]
    return resampled(clip, sample_rate=rate, wanted=sample_rate)[0].float()
