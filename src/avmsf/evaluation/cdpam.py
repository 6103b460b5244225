"""CDPAM: how different two sounds are perceived, by a network trained on listeners' answers.

Manocha, Jin, Zhang and Finkelstein, "CDPAM: Contrastive learning for perceptual audio similarity", ICASSP 2021; the
network and its weights are those of their package `cdpam`, at 22,050 Hz. It is not free of level, and two scalings of
one and the same sound are in use, whose figures differ by orders of magnitude:

- `benchmark`: sounds as fractions of full scale, -1 to 1. The ObjectFolder benchmark calls it so, and figures near
  1e-4, as the paper has them, come about in no other way. [inferred]
- `authors`: samples as 16-bit integers, so the same times 32768 and rounded, as the network was trained.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.evaluation.cdpam_network import FEATURES, CdpamNetwork
from avmsf.evaluation.cdpam_weights import find_weights, read_weights
from avmsf.evaluation.conventions import Convention
from avmsf.evaluation.convolution import Workspace
from avmsf.evaluation.metrics import PerContact, resampled, validate, validate_sounds

Scaling = Literal["benchmark", "authors"]
SAMPLE_RATE = 22050.0
"""Hz that sounds are resampled to (polyphase)."""
KEYS: dict[Scaling, str] = {"benchmark": "cdpam", "authors": "cdpam_scaled"}
"""What a report calls the distance in each scaling."""
_FULL_SCALE = 32768.0
_ARITHMETIC = "1"
"""Part of the names of kept embeddings; another number where they are computed otherwise than before."""


@dataclass(frozen=True, eq=False)
class Cdpam(Convention):
    """The network, and what it made of every sound so far; `Cdpam.load()` makes one.

    Two sounds' distance is the sum of the absolute differences of their embeddings, so that each sound is embedded
    once, however many others it is compared with.
    """

    network: CdpamNetwork
    digest: str
    """SHA-256 of the weights' file."""
    folder: Path | None = None
    """Where embeddings outlive the process, 3 kB a sound; any number of processes may share it. None keeps none."""
    scalings: Sequence[Scaling] = ("benchmark", "authors")
    """Those that `scores` has; each costs an embedding a sound."""
    _made: dict[str, Float64[Tensor, " features"]] = field(default_factory=dict, repr=False)

    @classmethod
    def load(cls, folder: Path | None = None, *, scalings: Sequence[Scaling] = ("benchmark", "authors")) -> "Cdpam":
        """Read the installed package's weights, half a gigabyte once they are arranged.

        Raises EvaluationError where the package is missing or its weights are not those known here.
        """
        weights = read_weights(find_weights())
        return cls(CdpamNetwork.of(weights), weights.digest, folder, scalings)

    @property
    def name(self) -> str:
        """What a report calls the convention."""
        return "cdpam"

    def scores(
        self, predicted: Float[Tensor, "..."], truth: Float[Tensor, "..."], *, sample_rate: float
    ) -> dict[str, PerContact]:
        """Return `cdpam` and `cdpam_scaled` of every contact, or that of them which `scalings` has."""
        return {
            KEYS[scaling]: self.distance(predicted, truth, sample_rate=sample_rate, scaling=scaling)
            for scaling in self.scalings
        }

    def distance(
        self,
        predicted: Float[Tensor, "..."],
        truth: Float[Tensor, "..."],
        *,
        sample_rate: float,
        scaling: Scaling = "benchmark",
    ) -> PerContact:
        """Return each contact's distance; sounds are fractions of full scale. Raises as `validate` and `resampled`."""
        validate(predicted, truth)
        embeddings = [self.embed(sounds, sample_rate=sample_rate, scaling=scaling) for sounds in (predicted, truth)]
        return (embeddings[0] - embeddings[1]).abs().sum(dim=1)

    def embed(
        self, sounds: Float[Tensor, "..."], *, sample_rate: float, scaling: Scaling = "benchmark"
    ) -> Float64[Tensor, "contacts features"]:
        """Return the features that the distance compares; they are remembered by the sounds' samples.

        Sounds [contacts, samples] are fractions of full scale. Raises EvaluationError for sounds that are empty or not
        finite, and for a rate that is not positive.
        """
        validate_sounds(sounds)
        workspace = Workspace()
        return torch.stack(
            [self._embed_one(sound, sample_rate, scaling, workspace) for sound in sounds.detach().cpu().double()]
        )

    def _embed_one(
        self, sound: Float64[Tensor, " samples"], sample_rate: float, scaling: Scaling, workspace: Workspace
    ) -> Float64[Tensor, " features"]:
        what = f"{_ARITHMETIC} {self.digest} {scaling} {float(sample_rate)!r} ".encode()
        key = hashlib.sha256(what + sound.numpy().tobytes()).hexdigest()
        if key not in self._made:
            kept = None if self.folder is None else _read(self.folder / f"{key}.npy")
            if kept is None:
                kept = self._compute(sound, sample_rate, scaling, workspace)
                if self.folder is not None:
                    _keep(self.folder / f"{key}.npy", kept)
            self._made[key] = kept
        return self._made[key]

    def _compute(
        self, sound: Float64[Tensor, " samples"], sample_rate: float, scaling: Scaling, workspace: Workspace
    ) -> Float64[Tensor, " features"]:
        heard = resampled(sound[None], sample_rate=sample_rate, wanted=SAMPLE_RATE)[0]
        if scaling == "authors":
            heard = torch.round(heard * _FULL_SCALE)
        with torch.inference_mode():
            features = self.network.features(heard.float(), workspace)
        if not bool(torch.isfinite(features).all()):
            raise EvaluationError(
                f"expected sounds as fractions of full scale, 1, got a peak of {float(sound.abs().max()):g}",
                name="sounds",
                value=float(sound.abs().max()),
            )
        return features.clone()


def _read(path: Path) -> Float64[Tensor, " features"] | None:
    """Return a kept embedding; None where there is none or it is damaged."""
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    if values.shape != (FEATURES,) or values.dtype != np.float64 or not np.isfinite(values).all():
        return None
    return torch.from_numpy(values)


def _keep(path: Path, features: Float64[Tensor, " features"]) -> None:
    def write(place: Path) -> None:
        with open(place, "wb") as file:
            np.save(file, features.numpy(), allow_pickle=False)

    write_whole(path, write, raising=EvaluationError)
