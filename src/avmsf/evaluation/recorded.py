"""Sounds of other systems, from files, as a method."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import read_recording
from avmsf.errors import CaptureError, EvaluationError
from avmsf.evaluation.task import Contacts, Sounds, Task


@dataclass(frozen=True, eq=False)
class Recorded:
    """Wav files, one a recording of the object, that are looked up by the contact of that recording.

    FOLDER/RECORDING.wav for the recording called RECORDING or RECORDING.wav, whose name may hold folders. Of several
    recordings at one contact the first with a file is used for all. Files are read on demand, so that only those of the
    evaluated contacts are needed.
    """

    task: Task
    """Has the contacts and names of the object's recordings, and the sample rate and length that files must have."""
    folder: Path
    """Holds the object's files."""

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            wanted = f"a folder with the object's sounds, such as {self.path(self.task.names[0]).name}"
            advice = "render them there, or omit the object"
            raise EvaluationError.expected(wanted, file=self.folder, advice=advice)

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.task.train.sample_rate

    @property
    def samples(self) -> int:
        """Samples of each sound."""
        return self.task.train.sounds.shape[1]

    def path(self, name: str) -> Path:
        """Return where the sound that stands for a recording is expected."""
        return self.folder / (name if name.lower().endswith(".wav") else f"{name}.wav")

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the files' sounds, as they are.

        Raises EvaluationError for a contact without a recording, for a missing file, and for one that is no sound, has
        several different channels or another rate or length.
        """
        sounds = [self._read(self._find(contact)) for contact in contacts]
        return torch.stack(sounds) if sounds else torch.zeros(0, self.samples)

    def _find(self, contact: Float[Tensor, "3"]) -> Path:
        # Contacts that went through float32 are still the same points; a micrometer is far below any two's distance.
        rows = torch.nonzero((self.task.contacts.double() - contact.double()).norm(dim=1) < 1e-6).flatten().tolist()
        if not rows:
            position = ", ".join(f"{value:g}" for value in contact.tolist())
            raise EvaluationError.expected(
                "a contact of a recording, at which alone sounds from files are available",
                contact.tolist(),
                got=f"({position}) m",
                file=self.folder,
                name="contacts",
            )
        paths = [self.path(self.task.names[row]) for row in rows]
        present = [path for path in paths if path.is_file()]
        if not present:
            raise EvaluationError.expected(
                self._wanted, got="no such file", file=paths[0], name=self.task.names[rows[0]], advice="render it"
            )
        return present[0]

    def _read(self, path: Path) -> Float[Tensor, " samples"]:
        try:
            recording = read_recording(path)
        except CaptureError as error:
            raise EvaluationError(str(error), **{**error.attributes, "file": path}) from error
        found = recording.frames, recording.sample_rate, len(np.unique(recording.channels, axis=0))
        if found != (self.samples, self.sample_rate, 1):
            shown = f"{found[0]} samples at {found[1]:g} Hz in {found[2]} different channels"
            advice = "render it again, from the onset on, and save it as mono"
            raise EvaluationError.expected(self._wanted, found, got=shown, file=path, name="samples", advice=advice)
        return torch.from_numpy(recording.channels[0].copy()).float()

    @property
    def _wanted(self) -> str:
        return f"a mono wav of {self.samples} samples at {self.sample_rate:g} Hz, as the recordings have"


@dataclass(frozen=True)
class RecordedMethod:
    """Another system, by its wav files: FOLDER/OBJECT/RECORDING.wav, as `Recorded` reads them."""

    name: str
    """`recorded:` and the folder."""
    path: Path
    """Holds a folder of sounds for every object."""

    def digest(self, name: str) -> str:
        """Return a digest of an object's wavs, which decide its figures."""
        digest, folder = hashlib.sha256(), self.path / name
        for file in sorted(folder.rglob("*")):
            if file.suffix.lower() == ".wav" and file.is_file():
                digest.update(f"{file.relative_to(folder).as_posix()}\0{file.stat().st_size}\0".encode())
                digest.update(file.read_bytes())
        return digest.hexdigest()

    def fit(self, task: Task) -> Recorded:
        """Find the object's folder. Raises EvaluationError where there is none."""
        return Recorded(task, self.path / task.name)
