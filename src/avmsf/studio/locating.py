"""Localization for the page: tables are computed in advance, so that a recording is located at once."""

import base64
import dataclasses
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import Recording, SoundBytes, decode_recording
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import RecordingLengthError
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import LEVEL, ContactMap, enlarged, symmetries_of
from avmsf.localization.locator import Locator
from avmsf.localization.multi_impact import locate_impacts
from avmsf.studio.refusal import RefusedError
from avmsf.symmetry.symmetries import Symmetries


class Likeness:
    """The symmetries of one object, which an edit that makes it larger leaves as they are but for their lengths."""

    def __init__(self) -> None:
        self._found: tuple[Symmetries | None, float] | None = None
        self._lock = Lock()

    def on(self, field: SoundField, length: float) -> Symmetries | None:
        """Return the symmetries of a field's object, `length` times as large as the one in the page; None for none."""
        with self._lock:
            if self._found is None:
                self._found = (symmetries_of(field), length)
            found, before = self._found
        return None if found is None else enlarged(found, length / before)


@dataclass(frozen=True, eq=False)
class Finder:
    """The locator of one revision of a field, made at its first use."""

    field: SoundField
    points: Float[Tensor, "points 3"]
    """The page's points, on the object as the field has it now, meters."""
    length: float
    """Lengths on that object over those of the page's picture."""
    likeness: "Likeness" = dataclasses.field(default_factory=lambda: Likeness())
    """The symmetries of the object, whose search other revisions need not repeat."""
    settings: CaptureSettings | None = None
    """How the capture's recordings are read, where it is known."""
    _lock: Lock = dataclasses.field(default_factory=Lock, repr=False)

    @cached_property
    def locator(self) -> Locator:
        """The tables over the page's points."""
        return Locator.of(self.field, points=self.points)

    @property
    def symmetries(self) -> Symmetries | None:
        """The reason why several positions sound the same."""
        return self.likeness.on(self.field, self.length)

    def prepare(self) -> None:
        """Compute the tables, once for all threads."""
        with self._lock:
            self.locator.prepare(self.field.samples)
            _ = self.symmetries

    def locate(self, recording: Recording) -> list[dict[str, Any]]:
        """Return the impacts of a recording, each with a value for every point of the page.

        Lengths are in the page's frame, meters. Raises LocationError as `locate_impacts`.
        """
        self.prepare()
        impacts = locate_impacts(self.field, recording, settings=self.settings, locator=self.locator)
        return [self._described(seconds, contact) for seconds, contact in impacts]

    def _described(self, seconds: float, contact: ContactMap) -> dict[str, Any]:
        values = contact.describe(self.symmetries, LEVEL)
        for each in (values, values["cosine"], *values["equivalent_points"]):
            each["position"] = [value / self.length for value in each["position"]]
        values["credible_region"]["radius"] /= self.length
        return {
            "seconds": seconds,
            "row": contact.most_probable,
            "probability": packed(contact.probability),
            "distance": packed(contact.distance),
            **values,
        }


def read_upload(content: bytes, *, name: str = "the recording") -> Recording:
    """Return a recording that the page has sent.

    Raises CaptureError for a file that is no sound, and RefusedError (413) for one of excessive length: compressed
    silence of hours takes a few bytes.
    """
    try:
        return decode_recording(SoundBytes(content), name)
    except RecordingLengthError as error:
        raise RefusedError(413, str(error), **error.attributes) from error


def packed(values: Float[Tensor, " points"]) -> str:
    """Return values as the page unpacks them: base64 of float32, little endian."""
    return base64.b64encode(values.detach().to(torch.float32).numpy().astype(np.dtype("<f4")).tobytes()).decode()
