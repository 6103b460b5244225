"""The recordings of one object: where it was struck, and what was heard."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

_SINC_HALF_WIDTH = 32
"""Samples on either side that a value between two samples is interpolated from."""
_WHOLE_SAMPLE = 1e-3
"""Samples below which a fraction is not worth interpolating: it turns a mode at half the rate by .003 rad."""


@dataclass(frozen=True, eq=False)
class Impacts:
    """Blows on one object, one row a blow, all at one sample rate and of one length."""

    contacts: Float[Tensor, "contacts 3"]
    """Contact points in the object frame, metres; read in float64, so that equal distances stay equal."""
    sounds: Float[Tensor, "contacts samples"]
    """Response to each blow, starting at its onset; per newton where the forces are known, else as recorded."""
    sample_rate: float
    """Samples per second of `sounds`, Hz."""
    names: tuple[str, ...]
    """What each recording is called, for messages and tables: its file's path in the capture folder."""
    directions: Float[Tensor, "contacts 3"] | None = None
    """Unit vectors along which the hammer moved, where they are known."""
    forces: Float[Tensor, " contacts"] | None = None
    """Peak force of each blow that `sounds` was divided by, newtons, where it is known."""
    before: Float[Tensor, "contacts lead"] | None = None
    """What each file holds just before `sounds`, in the same unit; NaN where it holds nothing. None where the sounds
    are final: aligned already, or given without their files."""
    after: Float[Tensor, "contacts tail"] | None = None
    """What each file holds just after `sounds`, likewise; None together with `before`."""

    def __post_init__(self) -> None:
        if (self.before is None) != (self.after is None):
            raise ValueError("expected both before and after, or neither, got one of them")

    @property
    def duration(self) -> float:
        """Length of every sound, seconds."""
        return self.sounds.shape[1] / self.sample_rate

    def __len__(self) -> int:
        return len(self.names)

    def digest(self) -> str:
        """Return a digest of all that can be learnt from the recordings."""
        digest = hashlib.sha256(json.dumps([self.names, self.sample_rate]).encode())
        for tensor in (self.contacts, self.sounds, self.directions, self.forces, self.before, self.after):
            digest.update(b"none" if tensor is None else tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def take(self, rows: Sequence[int]) -> "Impacts":
        """Return the given rows alone, in the given order."""
        index = torch.as_tensor(list(rows), dtype=torch.long)
        return replace(
            self,
            contacts=self.contacts[index],
            sounds=self.sounds[index],
            names=tuple(self.names[row] for row in index.tolist()),
            directions=None if self.directions is None else self.directions[index],
            forces=None if self.forces is None else self.forces[index],
            before=None if self.before is None else self.before[index],
            after=None if self.after is None else self.after[index],
        )

    def delayed(self, delays: Float64[Tensor, " contacts"]) -> "Impacts":
        """Return the recordings cut anew, each starting `delays` samples later in its file (earlier where negative).

        Between samples by a windowed sinc. What a file does not hold is zero. The result is final: its `before` and
        `after` are None. Raises ValueError for delays that are not finite.
        """
        if not bool(torch.isfinite(delays).all()):
            raise ValueError(f"expected finite delays, got {delays.tolist()}")
        margins = [self.sounds.new_zeros(len(self), 0) if each is None else each for each in (self.before, self.after)]
        whole = torch.cat([margins[0], self.sounds, margins[1]], dim=1).nan_to_num(nan=0.0)
        samples, lead = self.sounds.shape[1], margins[0].shape[1]
        sounds = torch.stack(
            [_cut(row, lead + delay, samples) for row, delay in zip(whole, delays.tolist(), strict=True)]
        )
        return replace(self, sounds=sounds, before=None, after=None)


def _cut(signal: Float[Tensor, " frames"], start: float, samples: int) -> Float[Tensor, " samples"]:
    """Return `samples` samples of a signal from `start` on, which may lie between samples or outside the signal."""
    whole = round(start)
    offset = start - whole
    half = 0 if abs(offset) < _WHOLE_SAMPLE else _SINC_HALF_WIDTH
    first, last = whole - half, whole + samples + half
    padded = torch.nn.functional.pad(signal, (max(0, -first), max(0, last - len(signal))))
    piece = padded[max(0, first) : max(0, first) + samples + 2 * half]
    if half == 0:
        return piece.clone()
    taps = torch.arange(-half, half + 1, dtype=torch.float64) - offset
    # A Kaiser window of this shape leaves ripples of about -80 dB (Oppenheim and Schafer, eq. 7.75).
    window = torch.special.i0(8.0 * (1 - (taps / (half + 1)).square()).clamp(min=0).sqrt()) / float(np.i0(8.0))
    kernel = torch.sinc(taps) * window
    return torch.nn.functional.conv1d(piece.double()[None, None], kernel[None, None])[0, 0].to(signal.dtype)
