"""An embedding of objects by their modes, and distances of edited ones from their new material (paper, supplement).

The points are labelled objects' sets of modes, embedded by UMAP (umap-learn, extra `eval`); an edited object is placed
among them, and its score is the distance to the mean of the points of its target material, in the embedding's units,
lower is better. The paper gives neither UMAP's settings nor how a set becomes a vector, so
that its values and these cannot be compared.

UMAP always places a new point near known points, however far away it is. The plain distance between the vectors, in
octaves, has no such limit and needs no randomness and no package.

Here a set of any size becomes a vector whose Euclidean length is in octaves: a set with all frequencies doubled lies at
a distance of 1 from the one it was made of. The order of the modes does not matter, and neither does their number.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float64

from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank


@dataclass(frozen=True)
class Pitches:
    """The frequencies alone, as in the paper: evenly spaced quantiles of their logarithms.

    Component k of n is the quantile (k + 1/2) / n of log2 f by Hazen's rule, over sqrt(n), so that the distance of two
    sets is the root mean square of their quantiles' differences in octaves.
    """

    name: ClassVar[str] = "pitches"
    """What reports call it."""
    count: int = 32
    """Quantiles."""

    def vector(self, bank: ModalBank) -> Float64[np.ndarray, " dim"]:
        """Return the vector of a set of modes. Raises EvaluationError for a set that is empty or not of numbers."""
        frequency, _ = _logarithms(bank)
        levels = (np.arange(self.count) + 0.5) / self.count
        return np.quantile(frequency, levels, method="hazen") / math.sqrt(self.count)

    def record(self) -> dict[str, Any]:
        """Return the name and the settings, as a file holds them."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class PitchesAndRings(Pitches):
    """The frequencies, and how fast each pitch decays.

    Frequencies alone hardly tell materials apart: sound runs equally fast, to 6 %, in ceramic, glass, iron and steel,
    and an object of twice the size is an octave lower. How fast they decay does. After the quantiles of `Pitches`
    follows, at evenly spaced pitches, log2 of the damping there, the mean over all modes weighted by
    exp(-(distance in octaves / width)^2 / 2), over the square root of their number.
    """

    name: ClassVar[str] = "pitches and rings"
    rings: int = 15
    """Pitches at which dampings are compared, from 125 Hz to 16 kHz: two an octave."""
    width: float = 0.5
    """Octaves."""

    def vector(self, bank: ModalBank) -> Float64[np.ndarray, " dim"]:
        """Return the quantiles and the dampings."""
        frequency, damping = _logarithms(bank)
        pitches = np.linspace(math.log2(125.0), math.log2(16000.0), self.rings)
        exponent = -0.5 * ((frequency[None] - pitches[:, None]) / self.width) ** 2
        # Relative to the nearest mode's, lest all weights vanish far away from every mode.
        weights = np.exp(exponent - exponent.max(axis=1, keepdims=True))
        curve = weights @ damping / weights.sum(axis=1)
        return np.concatenate([super().vector(bank), curve / math.sqrt(self.rings)])


def _logarithms(bank: ModalBank) -> tuple[Float64[np.ndarray, " modes"], Float64[np.ndarray, " modes"]]:
    """Return log2 of frequencies and dampings."""
    if not len(bank):
        raise EvaluationError("expected a bank of one mode or more, got none", name="bank", value=0)
    both = torch.stack([bank.frequency, bank.damping])
    wrong = torch.nonzero(~(torch.isfinite(both) & (both > 0)))
    if len(wrong):
        which, row = wrong[0].tolist()
        name = ("frequency", "damping")[which]
        value = float(both[which, row])
        raise EvaluationError(f"mode {row}: expected a {name} above 0, got {value:g}", row=row, name=name, value=value)
    frequency, damping = torch.log2(both).numpy()
    return frequency, damping


_FEWEST = 6
"""Objects that UMAP has anything to arrange of."""
_PACKAGES = ("umap-learn", "numba", "numpy", "scipy", "scikit-learn", "avmsf")
"""Those that an embedding depends on, down to its last digits."""


@dataclass(frozen=True)
class UmapSettings:
    """How UMAP arranges the objects; everything else as umap-learn has it."""

    neighbors: int = 8
    """Objects that each one's place is decided by; one less than all where these are fewer."""
    least_distance: float = 0.1
    """How close points may come: `min_dist`."""
    seed: int = 0
    """Start of all chance: one seed gives one embedding, on one core."""


@dataclass(frozen=True, eq=False)
class MaterialSpace:
    """Labelled objects by their modes; `MaterialSpace.of` makes one."""

    features: Pitches
    materials: tuple[str, ...]
    """Each object's, row for row."""
    names: tuple[str, ...]
    """What each object is called."""
    vectors: Float64[np.ndarray, "objects dim"]
    settings: UmapSettings

    @classmethod
    def of(
        cls,
        mode_sets: Sequence[ModalBank],
        materials: Sequence[str],
        seed: int = 0,
        *,
        names: Sequence[str] | None = None,
        features: Pitches | None = None,
        settings: UmapSettings | None = None,
    ) -> "MaterialSpace":
        """Return the space of labelled sets of modes; `features` are `Pitches()`, the paper's, unless others are given.

        `settings` carry a seed of their own. Raises EvaluationError for labels that do not fit the sets, for fewer than
        six objects or two materials, and as the features do, with the object's name.
        """
        chosen = Pitches() if features is None else features
        called = tuple(f"object {row}" for row in range(len(mode_sets))) if names is None else tuple(names)
        if not len(mode_sets) == len(materials) == len(called):
            raise EvaluationError(
                f"expected a material and a name for each of {len(mode_sets)} sets of modes, got {len(materials)} "
                f"materials and {len(called)} names",
                name="materials" if len(materials) != len(mode_sets) else "names",
                value=len(materials) if len(materials) != len(mode_sets) else len(called),
            )
        if len(mode_sets) < _FEWEST or len(set(materials)) < 2:
            raise EvaluationError(
                f"expected {_FEWEST} objects of two materials or more, got {len(mode_sets)} objects of "
                f"{len(set(materials))} materials",
                name="mode_sets",
                value=(len(mode_sets), len(set(materials))),
            )
        vectors = []
        for name, bank in zip(called, mode_sets, strict=True):
            try:
                vectors.append(chosen.vector(bank))
            except EvaluationError as error:
                raise EvaluationError(f"{name}: {error}", **{**error.attributes, "name": name}) from error
        settings = UmapSettings(seed=seed) if settings is None else settings
        return cls(chosen, tuple(materials), called, np.stack(vectors), settings)

    @property
    def known(self) -> tuple[str, ...]:
        """All materials that objects are of, in the order of the alphabet."""
        return tuple(sorted(set(self.materials)))

    @cached_property
    def embedding(self) -> Float[np.ndarray, "objects 2"]:
        """Where UMAP has the objects. Raises EvaluationError where umap-learn is missing."""
        return np.asarray(self._umap.embedding_)

    def place(self, bank: ModalBank) -> Float[np.ndarray, " 2"]:
        """Return where UMAP puts another set of modes; it depends on this set alone."""
        vector = self.features.vector(bank)
        with warnings.catch_warnings():
            _quieten()
            return np.asarray(self._umap.transform(vector[None]))[0]

    def center(self, material: str) -> Float[np.ndarray, " 2"]:
        """Return the mean of the points of a material. Raises EvaluationError with the materials there are."""
        return self.embedding[self._rows(material)].mean(axis=0)

    def distance(self, place: Float[np.ndarray, " 2"], material: str) -> float:
        """Return how far a place is from a material's center, in UMAP's units."""
        return float(np.linalg.norm(place - self.center(material)))

    def plain_distance(self, bank: ModalBank, material: str) -> float:
        """Return how far a set of modes is from the mean of a material's vectors, octaves, without any UMAP."""
        center = self.vectors[self._rows(material)].mean(axis=0)
        return float(np.linalg.norm(self.features.vector(bank) - center))

    def spread(self, material: str) -> float:
        """Return the mean distance of a material's own points from their center, in UMAP's units."""
        own = self.embedding[self._rows(material)]
        return float(np.linalg.norm(own - own.mean(axis=0), axis=1).mean())

    def nearest_neighbor_accuracy(self) -> float:
        """Return the part of objects whose nearest other object, by the plain vectors, is of their own material.

        What a distance to a material can mean at all: objects drawn at random would have the materials' shares.
        """
        apart = np.linalg.norm(self.vectors[:, None] - self.vectors[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        nearest = apart.argmin(axis=1)
        return float(np.mean([self.materials[row] == self.materials[other] for row, other in enumerate(nearest)]))

    def record(self) -> dict[str, Any]:
        """Return all that the scores rest on, as JSON holds it: settings, versions, vectors and the embedding."""
        return {
            "features": self.features.record(),
            "umap": asdict(self.settings),
            "versions": {name: version(name) for name in _PACKAGES},
            "materials": list(self.materials),
            "names": list(self.names),
            "vectors": self.vectors.tolist(),
            "embedding": self.embedding.tolist(),
            "centers": {material: self.center(material).tolist() for material in self.known},
        }

    def _rows(self, material: str) -> list[int]:
        rows = [row for row, own in enumerate(self.materials) if own == material]
        if not rows:
            raise EvaluationError(
                f"expected a material of {', '.join(self.known)}, got {material!r}", name="material", value=material
            )
        return rows

    @cached_property
    def _umap(self) -> Any:
        """Return umap-learn's model, fitted to the vectors."""
        umap = _import_umap()
        model = umap.UMAP(
            n_components=2,
            n_neighbors=min(self.settings.neighbors, len(self.vectors) - 1),
            min_dist=self.settings.least_distance,
            random_state=self.settings.seed,
            transform_seed=self.settings.seed,
            n_jobs=1,
        )
        with warnings.catch_warnings():
            _quieten()
            model.fit(self.vectors)
        return model


def _quieten() -> None:
    """Ignore the warnings of umap-learn and its dependencies."""
    warnings.simplefilter("ignore")


def _import_umap() -> Any:
    # Half a minute the first time, while numba compiles: so only those who embed pay for it.
    try:
        with warnings.catch_warnings():
            _quieten()
            import umap
    except ImportError as error:
        raise EvaluationError(
            f"UMAP distance: expected the package umap-learn, got {error}; pip install 'avmsf[eval]'",
            name="umap-learn",
        ) from error
    return umap
