"""An embedding of objects by their modes, and distances of edited ones from their new material (paper, supplement).

The points are labelled objects' sets of modes, embedded by UMAP (umap-learn, extra `eval`); an edited object is placed
among them, and its score is the distance to the mean of the points of its target material, in the embedding's units,
lower is better. The paper gives neither UMAP's settings nor how a set becomes a vector: its values and these cannot be
compared. UMAP places a new point near known points, however far away it is.
"""

import math
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from avmsf.errors import EvaluationError, from_extra
from avmsf.modal.modes import ModalBank

_QUANTILES = 32
_PITCHES, _WIDTH = 15, 0.5
"""Pitches at which dampings are compared, from 125 Hz to 16 kHz, two an octave; and the width of the mean, octaves."""
_MIN_OBJECTS = 6
"""Objects that UMAP has anything to arrange of."""
_NEIGHBORS, _MIN_DISTANCE = 8, 0.1
"""Objects that each one's place is decided by, and how close points may come; all else is umap-learn's default."""
_PACKAGES = ("umap-learn", "numba", "numpy", "scipy", "scikit-learn", "avmsf")
"""Those that an embedding depends on, down to its last digits."""


def pitches(bank: ModalBank) -> Float64[np.ndarray, " dim"]:
    """Return the frequencies alone, as in the paper: 32 evenly spaced quantiles of log2 f, by Hazen's rule.

    Over the square root of their number, so that the distance of two sets is the root mean square of their quantiles'
    differences in octaves.
    """
    levels = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    return np.quantile(bank.frequency.log2().numpy(), levels, method="hazen") / math.sqrt(_QUANTILES)


def pitches_and_dampings(bank: ModalBank) -> Float64[np.ndarray, " dim"]:
    """Return the frequencies as `pitches` does, and how fast each pitch decays, which tells materials apart.

    Frequencies alone hardly do: sound runs equally fast, to 6 %, in ceramic, glass, iron and steel. At evenly spaced
    pitches follows log2 of the damping there, the mean over all modes weighted by exp(-(distance in octaves /
    width)^2 / 2), over the square root of their number.
    """
    frequency, damping = bank.frequency.log2().numpy(), bank.damping.log2().numpy()
    exponent = np.linspace(math.log2(125.0), math.log2(16000.0), _PITCHES)[:, None] - frequency
    exponent = -0.5 * (exponent / _WIDTH) ** 2
    # Relative to the nearest mode's, lest all weights vanish far away from every mode.
    weights = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    curve = weights @ damping / weights.sum(axis=1)
    return np.concatenate([pitches(bank), curve / math.sqrt(_PITCHES)])


FEATURES: dict[str, Callable[[ModalBank], Float64[np.ndarray, " dim"]]] = {
    "umap": pitches,
    "umap_dampings": pitches_and_dampings,
}
"""What makes a vector of a set of modes, by the metrics that rest on it."""


def check_materials(known: Collection[str], *, name: str = "materials") -> None:
    """Raise EvaluationError, about `name`, for fewer objects or materials than an embedding takes."""
    if len(known) < _MIN_OBJECTS or len(set(known)) < 2:
        found, wanted = (len(known), len(set(known))), f"{_MIN_OBJECTS} objects or more, of two known materials or more"
        raise EvaluationError.expected(wanted, found, got="{} of {}".format(*found), name=name)


@dataclass(frozen=True, eq=False)
class MaterialSpace:
    """Labelled objects by their modes; `MaterialSpace.of` makes one."""

    features: str
    """Of `FEATURES`."""
    materials: tuple[str, ...]
    """Each object's, row for row."""
    names: tuple[str, ...]
    """What each object is called."""
    vectors: Float64[np.ndarray, "objects dim"]
    seed: int
    """Start of all chance: one seed gives one embedding, on one core."""

    @classmethod
    def of(
        cls,
        mode_sets: Sequence[ModalBank],
        materials: Sequence[str],
        *,
        names: Sequence[str],
        features: str = "umap",
        seed: int = 0,
    ) -> "MaterialSpace":
        """Return the space of labelled sets of modes, by the paper's features unless others are named."""
        vectors = np.stack([FEATURES[features](bank) for bank in mode_sets])
        return cls(features, tuple(materials), tuple(names), vectors, seed)

    @cached_property
    def embedding(self) -> Float[np.ndarray, "objects 2"]:
        """Where UMAP has the objects. Raises EvaluationError where umap-learn is missing."""
        return np.asarray(self._umap.embedding_)

    def place(self, bank: ModalBank) -> Float[np.ndarray, " 2"]:
        """Return where UMAP puts another set of modes; it depends on this set alone."""
        vector = FEATURES[self.features](bank)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.asarray(self._umap.transform(vector[None]))[0]

    def center(self, material: str) -> Float[np.ndarray, " 2"]:
        """Return the mean of the points of a material."""
        return self.embedding[np.array(self.materials) == material].mean(axis=0)

    def distance(self, place: Float[np.ndarray, " 2"], material: str) -> float:
        """Return how far a place is from a material's center, in UMAP's units."""
        return float(np.linalg.norm(place - self.center(material)))

    def record(self) -> dict[str, Any]:
        """Return all that the scores rest on, as JSON holds it: settings, versions, vectors and the embedding."""
        return {
            "features": self.features,
            "umap": {"neighbors": _NEIGHBORS, "min_distance": _MIN_DISTANCE, "seed": self.seed},
            "materials": list(self.materials),
            "names": list(self.names),
            "vectors": self.vectors.tolist(),
            "embedding": self.embedding.tolist(),
            "versions": {name: version(name) for name in _PACKAGES},
        }

    @cached_property
    def _umap(self) -> Any:
        """Return umap-learn's model, fitted to the vectors."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with from_extra("eval", "umap-learn", raising=EvaluationError):
                # Half a minute the first time, while numba compiles: so only those who embed pay for it.
                import umap
            model = umap.UMAP(
                n_components=2,
                n_neighbors=min(_NEIGHBORS, len(self.vectors) - 1),
                min_dist=_MIN_DISTANCE,
                random_state=self.seed,
                transform_seed=self.seed,
                n_jobs=1,
            )
            return model.fit(self.vectors)
