"""Where a recorded blow fell, for the page: the tables are made ahead of time, a recording is answered at once."""

import base64
import dataclasses
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.settings import CaptureSettings
from avmsf.field.soundfield import SoundField
from avmsf.scene.symmetry import Symmetries
from avmsf.tasks.contactmap import LEVEL, ContactMap
from avmsf.tasks.located import describe_blow, symmetries_of
from avmsf.tasks.locator import Locator
from avmsf.tasks.severalblows import locate_blows


@dataclass(frozen=True, eq=False)
class Finder:
    """What is needed to locate blows on one revision of a field; made when it is first asked for."""

    field: SoundField
    points: Float[Tensor, "points 3"]
    """The page's points, on the object as the field has it now, metres."""
    length: float
    """Lengths on that object over those of the page's picture."""
    settings: CaptureSettings | None = None
    """How the capture's recordings are read, where it is known."""
    _lock: Lock = dataclasses.field(default_factory=Lock, repr=False)

    @cached_property
    def locator(self) -> Locator:
        """The tables over the page's points."""
        return Locator.of(self.field, points=self.points)

    @cached_property
    def symmetries(self) -> Symmetries | None:
        """What explains why several places sound the same."""
        return symmetries_of(self.field)

    def prepare(self) -> None:
        """Make all that takes time, once, whoever asks first."""
        with self._lock:
            _ = self.locator, self.symmetries

    def locate(self, recording: Recording) -> list[dict[str, Any]]:
        """Return the blows of a recording, each with a value for every point of the page.

        Lengths are those of the page's picture, metres. Raises LocationError as `locate_blows`.
        """
        self.prepare()
        blows = locate_blows(self.field, recording, settings=self.settings, locator=self.locator)
        return [self._described(seconds, contact) for seconds, contact in blows]

    def _described(self, seconds: float, contact: ContactMap) -> dict[str, Any]:
        values = describe_blow(contact, self.symmetries, LEVEL)
        for each in (values, values["cosine"], *values["counterparts"]):
            each["place"] = [value / self.length for value in each["place"]]
        values["region"]["radius_metres"] /= self.length
        return {
            "seconds": seconds,
            "row": contact.most_probable,
            "probability": packed(contact.probability),
            "distance": packed(contact.distance),
            **values,
        }


def read_upload(content: bytes, *, name: str = "the recording") -> Recording:
    """Return the recording that a page has sent. Raises CaptureError for what is no sound file."""
    with tempfile.TemporaryDirectory(prefix="avmsf-upload-") as folder:
        path = Path(folder) / "upload.wav"
        path.write_bytes(content)
        return read_recording(path, name)


def packed(values: Float[Tensor, " points"]) -> str:
    """Return values as the page unpacks them: base64 of float32, little endian."""
    return base64.b64encode(values.detach().to(torch.float32).numpy().astype(np.dtype("<f4")).tobytes()).decode()
