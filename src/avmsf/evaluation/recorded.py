"""Sounds of another system, from files, evaluated like those of any renderer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import read_recording
from avmsf.errors import CaptureError, EvaluationError


@dataclass(frozen=True, eq=False)
class Recorded:
    """Wav files, one a recording of the object, that are looked up by the contact of that recording.

    FOLDER/RECORDING.wav for the recording called RECORDING or RECORDING.wav, whose name may hold folders. Of several
    recordings at one contact the first with a file is used for all. Files are read on demand, so that only those of the
    evaluated contacts are needed.
    """

    folder: Path
    """Holds the object's files."""
    contacts: Float[Tensor, "contacts 3"]
    """Contacts of the object's recordings, meters."""
    names: tuple[str, ...]
    """The recordings' names, row for row."""
    sample_rate: float
    """Samples per second that the files must have, Hz."""
    samples: int
    """Samples that each file must have."""

    def __post_init__(self) -> None:
        if len(self.contacts) != len(self.names):
            raise EvaluationError.expected(
                f"one for each of {len(self.contacts)} contacts", len(self.names), name="names"
            )
        if not self.folder.is_dir():
            example = self.path(self.names[0]).name if self.names else "RECORDING.wav"
            raise EvaluationError.expected(
                f"a folder with the object's sounds, such as {example}",
                file=self.folder,
                advice="render them there, or omit the object",
            )

    def path(self, name: str) -> Path:
        """Return where the sound that stands for a recording is expected."""
        return self.folder / (name if name.lower().endswith(".wav") else f"{name}.wav")

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the files' sounds, as they are.

        Raises EvaluationError for a contact without a recording, for a missing file, and for one that is no sound, has
        several different channels or another rate or length.
        """
        sounds = [self._read(self._find(contact)) for contact in contacts]
        return torch.stack(sounds) if sounds else torch.zeros(0, self.samples)

    def _find(self, contact: Float[Tensor, "3"]) -> Path:
        # Contacts that went through float32 are still the same places; a micrometer is far below any two's distance.
        rows = torch.nonzero((self.contacts.double() - contact.double()).norm(dim=1) < 1e-6).flatten().tolist()
        if not rows:
            place = ", ".join(f"{value:g}" for value in contact.tolist())
            raise EvaluationError(
                f"{self.folder}: expected a contact of a recording, got ({place}) m; sounds from files are available "
                "at recorded contacts only",
                file=self.folder,
                name="contacts",
                value=contact.tolist(),
            )
        paths = [self.path(self.names[row]) for row in rows]
        present = [path for path in paths if path.is_file()]
        if not present:
            raise EvaluationError.expected(
                f"a mono wav of {self.samples} samples at {self.sample_rate:g} Hz",
                got="no such file",
                file=paths[0],
                name=self.names[rows[0]],
                advice="render it",
            )
        return present[0]

    def _read(self, path: Path) -> Float[Tensor, " samples"]:
        try:
            recording = read_recording(path)
        except CaptureError as error:
            raise EvaluationError(str(error), **{**error.attributes, "file": path}) from error
        if recording.sample_rate != self.sample_rate or recording.frames != self.samples:
            raise EvaluationError(
                f"{path}: expected {self.samples} samples at {self.sample_rate:g} Hz, as the recordings have, got "
                f"{recording.frames} at {recording.sample_rate:g} Hz; render it again, from the onset on",
                file=path,
                name="samples",
                value=(recording.frames, recording.sample_rate),
            )
        first = recording.channels[0]
        if any(not np.array_equal(channel, first) for channel in recording.channels[1:]):
            raise EvaluationError(
                f"{path}: expected one channel, got {len(recording.channels)} different ones; save it as mono",
                file=path,
                name="channels",
                value=len(recording.channels),
            )
        return torch.from_numpy(first.copy()).float()
