"""Guides towards reference sounds: recordings of another object, or synthetic sounds of a material."""

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
from avmsf.capture.measure import check_impulsive, find_clipping
from avmsf.capture.onset import find_second_impact
from avmsf.capture.prepare import prepare, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.editing.clips import levelled, resampled, with_length
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.editing.start_search import band_spectrum, search_start
from avmsf.errors import AvmsfWarning, CaptureError, EditError

_HELD = 0.9
"""Part of half a recording's rate up to which it still holds all of a sound."""
_FADE = 0.01
"""Seconds over which a reference that ends early hands over to the sound itself."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Target clips: each rendered sound moves towards the clip of the nearest spectrum, at its own level.

    Where a clip ends before the sound, the rest of the sound has no target.
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
            raise EditError.expected(f"one for each of {len(self.clips)} clips", len(self.lengths), name="lengths")
        if not bool(torch.isfinite(self.clips).all()):
            row = int(torch.nonzero(~torch.isfinite(self.clips))[0, 0])
            advice = f"record {self.name} again"
            raise EditError.expected("finite samples", got="NaN or inf", row=row, name="clips", advice=advice)
        silent = [row for row, clip in enumerate(self.clips) if float(clip.abs().max()) == 0.0]
        if silent:
            advice = f"omit it from {self.name}"
            raise EditError.expected("sounds", 0.0, got="silence", row=silent[0], name="clips", advice=advice)

    @classmethod
    def of(cls, sounds: Float[Tensor, "clips samples"], *, sample_rate: float, name: str = "reference") -> "Reference":
        """Refer to sounds at the field's rate that start at their onset, all of one length."""
        return cls(sounds.float(), (sounds.shape[1],) * len(sounds), sample_rate, name)

    @classmethod
    def read(cls, paths: str | Path | Sequence[str | Path], *, sample_rate: float) -> "Reference":
        """Read recordings of impacts and resample them to the field's `sample_rate`, Hz; a folder means its wav files.

        Each begins at its onset and ends at a second impact; of several channels the strongest is used. Raises
        `EditError` for a file that is missing, no sound, silent, shorter than 20 ms after the onset, or without an
        onset. Warns of a second impact, of clipping, and of a rate below the field's.
        """
        found = wav_files(paths)
        clips = [read_clip(path, sample_rate=sample_rate) for path in found]
        longest = max(len(clip) for clip in clips)
        name = found[0].name if len(found) == 1 else f"{found[0].name} and {len(found) - 1} more"
        padded = torch.cat([with_length(clip[None], longest) for clip in clips])
        return cls(padded, tuple(len(clip) for clip in clips), sample_rate, name)

    def describe(self) -> dict[str, Any]:
        """Return its identifying settings, as plain values."""
        digest = hashlib.sha256(self.clips.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
        return {"reference": self.name, "lengths": list(self.lengths), "samples_sha256": digest}

    def start(self, rendered: FieldAtContacts) -> ModalEdit:
        """Return the common pitch and decay with which the field comes nearest, from a search over both."""
        return search_start(rendered, self._nearest)

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
        clips = with_length(self.clips, samples).to(sounds)
        distance = torch.cdist(band_spectrum(sounds), band_spectrum(clips), p=1.0)
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
        raise EditError.expected(
            "one or more wav files",
            file=given[0] if given else None,
            name="reference",
            advice="give a sound file, or a folder with some",
        )
    return found


def read_clip(path: Path, *, sample_rate: float) -> Float[Tensor, " samples"]:
    """Return a recorded impact from its onset to the next, float32 at `sample_rate` Hz, of its strongest channel.

    Warns and raises `EditError` as `Reference.read`.
    """
    try:
        recording = read_recording(path)
        strongest = int(np.argmax(np.var(recording.channels, axis=1)))
        mono = replace(recording, channels=recording.channels[strongest : strongest + 1])
        prepared = prepare(mono, CaptureSettings())
        check_impulsive(mono.response(), sample_rate=mono.sample_rate, name=mono.name)
    except CaptureError as error:
        raise EditError(f"reference {error}", **{**error.attributes, "file": path}) from error
    sound, rate = prepared.sound, mono.sample_rate
    clipped = find_clipping(mono.response(), name=mono.name)
    notes = [] if clipped is None else [AvmsfWarning(clipped, file=path, name="clipping")]
    second = find_second_impact(sound, 0, sample_rate=rate, seconds=len(sound) / rate)
    if second is not None:
        at = (prepared.onset / rate, (prepared.onset + second) / rate)
        notes.append(
            AvmsfWarning(
                f"{mono.name}: expected one impact, got two at {at[0]:.3f} s and {at[1]:.3f} s; only the first is used",
                file=path,
                name="impacts",
                value=at,
            )
        )
        sound = sound[: max(second, shortest_allowed(rate))]
    if rate < sample_rate:
        notes.append(
            AvmsfWarning(
                f"{mono.name}: expected {sample_rate:g} Hz or more, got {rate:g} Hz; modes above "
                f"{_HELD * 0.5 * rate:.4g} Hz are edited towards silence",
                file=path,
                name="sample_rate",
                value=rate,
            )
        )
    for note in notes:
        warnings.warn(note, stacklevel=2)
    clip = torch.from_numpy(np.ascontiguousarray(sound - sound.mean()))[None]
    return resampled(clip, sample_rate=rate, wanted=sample_rate)[0].float()
