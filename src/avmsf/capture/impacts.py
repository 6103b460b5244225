"""The recordings of one object: where it was struck, and what was heard."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


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

    @property
    def duration(self) -> float:
        """Length of every sound, seconds."""
        return self.sounds.shape[1] / self.sample_rate

    def __len__(self) -> int:
        return len(self.names)

    def digest(self) -> str:
        """Return a digest of all that can be learnt from the recordings."""
        digest = hashlib.sha256(json.dumps([self.names, self.sample_rate]).encode())
        for tensor in (self.contacts, self.sounds, self.directions, self.forces):
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
        )
