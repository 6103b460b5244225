"""Simulated objects of known materials, for the benchmark of edits: four shapes in seven materials.

Each is in a size of its own, and its modes are those of finite elements: each shape is solved once and goes to every
material and size by the laws of linear elasticity, which are exact but for Poisson's ratio. That is .27 throughout, the
middle of the materials' .19 to .37, and moves frequencies by a few hundredths. Their sounds are rendered from the true
modes, without noise, and no mode has to be found in them; their fields know the true shapes.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.evaluation.editing import audible_modes
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies, CandidateBody
from avmsf.fem.damping import damped, rayleigh
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import MATERIALS, Material
from avmsf.fem.radiation import radiated
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.mesh.points import farthest_points
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.simulate.imperfections import stream
from avmsf.simulate.recipe import Hammer
from avmsf.simulate.shapes import make_shape
from avmsf.simulate.simulation import MAX_FREQUENCY_RATIO, SoundingBody, recorded

SHAPES = ("bowl", "mug", "plate", "pot")
"""Kinds of the simulated objects in the clusters."""
OTHER_SHAPES = ("goblet", "tray")
"""Kinds of the edited objects and of the references: no cluster has an object of the same shape."""
POISSON = 0.27
_MODES = 40
"""Lowest elastic modes of each shape."""
_CONTACTS, _POINTS = 16, 400
"""Recorded contacts, and all contacts of an edit."""
_MICROPHONE = (0.45, -0.35, 0.4)
"""From the middle of the object, meters."""
_SAMPLE_RATE, _SECONDS = 44100.0, 0.5
"""Of the sounds, Hz and s."""
_SMALLEST, _LARGEST = 0.7, 1.4
"""Factors on the size that a shape is drawn in."""


DIRECT = FitConfig(steps=0, damping="shared", residual=False)
"""Settings of a field without training end to end and without residual noise, which no edit changes."""


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object of a known material, its recordings, and its true modes."""

    name: str
    material: str
    impacts: Impacts
    modes: Extraction
    """Row for row of the impacts."""
    body: CandidateBody
    points: Float64[Tensor, "points 3"]
    """Of its surface, meters."""

    @property
    def bank(self) -> ModalBank:
        """Its audible modes."""
        return audible_modes(self.modes.bank, self.modes.gains)

    @cached_property
    def sound_field(self) -> SoundField:
        """Its field."""
        gains, features = MixtureEstimator(bodies=CandidateBodies([self.body])), FeatureField.from_points(self.points)
        return fit(self.impacts, features, self.modes, DIRECT, gains=gains, capture=self.name)


@dataclass(frozen=True, eq=False)
class SolvedShape:
    """A shape and its vibrations in one material, from which those in all others follow."""

    kind: str
    elastic: ElasticModes

    @classmethod
    def of(cls, kind: str, *, seed: int = 0, modes: int = _MODES) -> "SolvedShape":
        """Solve an individual of a kind. Raises SimulationError for an unknown kind."""
        basis = replace(MATERIALS["steel"], poisson=POISSON)
        return cls(kind, elastic_modes(make_shape(kind, seed=seed).solid, basis, count=modes))

    def remade(self, material: Material, *, size: float = 1.0) -> ElasticModes:
        """Return the vibrations in another material and `size` times as large, with the Poisson's ratio as it is.

        w' = w sqrt(E' / E) (r' / r)^(-1/2) / s and phi' = phi (r' / r)^(-1/2) s^(-3/2).
        """
        own = self.elastic.material
        density = material.density / own.density
        return replace(
            self.elastic,
            frequency=self.elastic.frequency * (math.sqrt(material.young / own.young / density) / size),
            nodes=self.elastic.nodes * size,
            shapes=self.elastic.shapes * (density**-0.5 * size**-1.5),
            material=replace(material, poisson=own.poisson),
            mass=self.elastic.mass * density * size**3,
        )

    def struck(self, material: Material, *, size: float) -> KnownObject:
        """Return the object in a material and size, struck at contacts far apart, straight into its surface."""
        elastic = self.remade(material, size=size)
        damping = torch.diag(rayleigh(elastic.frequency, material))
        vibration = damped(elastic.frequency, damping, highest=MAX_FREQUENCY_RATIO * _SAMPLE_RATE)
        middle = 0.5 * (elastic.nodes.amax(0) + elastic.nodes.amin(0))
        sound = radiated(elastic, vibration, middle + torch.tensor(_MICROPHONE, dtype=torch.float64))
        body = SoundingBody(elastic, vibration, sound, Hammer())
        contacts = elastic.nodes[self._spread[:_CONTACTS]]
        directions = -elastic.normals(contacts)
        amplitudes = body.gains(contacts, directions)
        starts, samples = torch.zeros(len(contacts), dtype=torch.float64), round(_SECONDS * _SAMPLE_RATE)
        sounds = recorded(vibration.poles, amplitudes, starts, sample_rate=_SAMPLE_RATE, samples=samples)
        names = tuple(f"{row + 1:03d}.wav" for row in range(len(contacts)))
        impacts = Impacts(contacts, sounds.float(), _SAMPLE_RATE, names, directions=directions.float())
        bank = ModalBank(vibration.frequency, vibration.damping)
        # Regression over shapes needs some variance: as much as noise 60 dB below the sounds would give.
        level = torch.full((17,), 1e-3 * float(sounds.square().mean().sqrt()))
        modes = Extraction(bank, (1j * amplitudes).to(torch.complex64), Residual(level))
        name, points = f"{self.kind}-{material.name}", elastic.nodes[self._spread]
        return KnownObject(name, material.name, impacts, modes, CandidateBody(None, elastic), points)

    @cached_property
    def _spread(self) -> Int[Tensor, " points"]:
        """Return rows of nodes all over the surface, the contacts first."""
        return farthest_points(self.elastic.nodes, min(_POINTS, len(self.elastic.nodes)))


def drawn_size(kind: str, material: str, *, seed: int) -> float:
    """Return the factor on a shape's size of a kind, a material and a seed: .7 to 1.4, evenly in octaves."""
    share = float(stream(seed, f"size of {kind} {material}").random())
    return _SMALLEST * (_LARGEST / _SMALLEST) ** share


def simulated_objects(shapes: Iterable[SolvedShape], *, seed: int = 0) -> tuple[KnownObject, ...]:
    """Return each shape in each material of the table, in sizes of their own."""
    return tuple(
        shape.struck(material, size=drawn_size(shape.kind, material.name, seed=seed))
        for shape in shapes
        for material in MATERIALS.values()
    )
