"""Objects whose materials are known, for the protocol of editing: recorded ones, and simulated ones of all materials.

Simulated objects are four shapes in seven materials, each in a size of its own, their modes those of finite elements:
each shape is solved once and goes to every material and size by the laws of linear elasticity, which are exact but for
Poisson's ratio. That is .27 throughout, the middle of the materials' .19 to .37, and moves frequencies by a few
hundredths. Their sounds are rendered from the true modes, without noise, and no mode has to be found in them; their
fields know the true shapes.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import NominalBodies, NominalBody
from avmsf.fem.damping import damped, rayleigh
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import MATERIALS, Material
from avmsf.fem.radiation import radiated
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.recipes import Attention, GainRecipe
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.points import farthest_points
from avmsf.modal.extraction.extract import Extraction, extract_modes, extract_sounds
from avmsf.modal.extraction.finders import ShortTime
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from avmsf.simulate.imperfections import stream
from avmsf.simulate.recipe import Hammer
from avmsf.simulate.shapes import make_shape
from avmsf.simulate.simulation import HIGHEST, SoundingBody, recorded

_CERAMIC = ("3_CeramicKoiBowl", "4_CeramicBowlFish", "9_BowlCeramic", "61_PlanterCeramic", "63_SmallPlanterCeramic",
            "64_CeramicMug", "65_PitcherCeramic")  # fmt: skip
_WOOD = ("27_WoodPlate", "28_WoodPlateSquare", "31_WoodSlab", "32_WoodChalice", "33_WoodWineGlass", "34_WoodMug",
         "68_WoodBoard")  # fmt: skip
_METAL = ("17_IronSkillet", "43_IronMortar", "67_IronPlate", "86_MetalHoledSpoon", "89_MetalSpatula", "90_MetalLadle",
          "91_MetalSpoon")  # fmt: skip
_PLASTIC = ("48_PlasticBowl", "49_PlasticBowl", "50_PlasticBowl", "97_PlasticScoop")
_GLASS = ("94_GlassGoblet",)
_LISTED = {"ceramic": _CERAMIC, "wood": _WOOD, "metal": _METAL, "plastic": _PLASTIC, "glass": _GLASS}
REALIMPACT_26: Mapping[str, str] = MappingProxyType(
    {name: material for material, names in _LISTED.items() for name in names}
)
"""Materials of 26 objects of RealImpact by their names. The paper evaluates on 26 and names none: the choice is ours.

Those whose name contains the material, the first seven of each by number, iron and metal as one, without
self-intersecting meshes. There is one of glass."""

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
_SMALLEST, _LARGEST = 0.7, 1.4
"""Factors on the size that a shape is drawn in."""
_FAINTEST_DB = -60.0
"""Energy relative to the strongest mode's, decibels, below which a mode is inaudible."""
DIRECT = FitConfig(steps=0, damping="shared", residual=False)
"""Settings of a field without training end to end and without residual noise, which no edit changes."""
PUBLISHED = replace(PAPER, damping="shared")
"""The paper's field. Its damping is not chosen: the five recordings of an object leave nothing to choose by."""


@dataclass(frozen=True, eq=False)
class PaperFields:
    """Objects as the paper reconstructs them: modes of section 3.4, and the attention network with residual noise."""

    features: Callable[[str], FeatureField]
    """Makes the visual features of an object, by its name."""
    config: FitConfig = PUBLISHED
    """Settings of the fit."""
    checkpoints: Path | None = None
    """Folder for the states of training, which a repeated call goes on from."""

    def object(self, name: str, material: str, impacts: Impacts) -> "KnownObject":
        """Return an object of a name. Raises ExtractionError where no mode is found."""
        modes = extract_sounds(impacts.sounds, sample_rate=impacts.sample_rate, method=ShortTime())
        kept = None if self.checkpoints is None else self.checkpoints / name
        return KnownObject(name, material, impacts, modes, Attention(), partial(self.features, name), self.config, kept)


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object of a known material, its recordings, and its modes."""

    name: str
    material: str
    impacts: Impacts
    modes: Extraction
    """True or extracted, row for row of the impacts."""
    recipe: GainRecipe = field(default_factory=MixtureEstimator)
    """The gain model of its field."""
    features: Callable[[], FeatureField] | None = None
    """Makes the points of its surface with what the gain model reads; the contacts alone where nothing is known."""
    config: FitConfig = DIRECT
    """Settings of its field."""
    checkpoint: Path | None = None
    """File for the state of the field's training."""

    @property
    def bank(self) -> ModalBank:
        """Its audible modes."""
        return audible_modes(self.modes.bank, torch.complex(self.modes.gains.double(), self.modes.quadrature.double()))

    @cached_property
    def sound_field(self) -> SoundField:
        """Its field."""
        features = FeatureField.from_points(self.impacts.contacts) if self.features is None else self.features()
        if self.checkpoint is not None:
            self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        return fit(
            self.impacts,
            features,
            self.modes,
            self.config,
            gains=self.recipe,
            capture=self.name,
            checkpoint=self.checkpoint,
        )


def audible_modes(bank: ModalBank, amplitudes: Tensor, *, sample_rate: float = math.inf) -> ModalBank:
    """Return the modes below half the sample rate (Hz) that are within 60 dB of the loudest, in energy.

    `amplitudes` [contacts, modes] are complex or real; a mode's energy is their mean square over 4 d. A mode that an
    edit has silenced or moved out of the band says nothing about a material. Raises EvaluationError where none is
    audible.
    """
    energy = amplitudes.abs().double().square().mean(dim=0) / (4.0 * bank.damping)
    energy = torch.where(bank.frequency < 0.5 * sample_rate, energy, 0.0)
    if not bool(energy.max() > 0.0):
        raise EvaluationError.expected(
            "a mode with energy below half the sample rate",
            len(bank),
            got=f"none among {len(bank)}",
            name="bank",
            advice="check the frequencies and amplitudes",
        )
    kept = energy >= energy.max() * 10.0 ** (_FAINTEST_DB / 10.0)
    return bank.take(kept)


def recorded_objects(
    dataset: Dataset, materials: Mapping[str, str] = REALIMPACT_26, *, paper: PaperFields | None = None
) -> tuple[KnownObject, ...]:
    """Read objects of a dataset by name and material, and extract their modes from all of their recordings.

    Modes and fields are those of the default, fitted without training, or the `paper`'s. Objects that the dataset does
    not hold are left out, so that a part of it will do. Raises DatasetError and ExtractionError as reading and
    extracting do.
    """
    found = []
    for name in dataset.objects():
        if name in materials:
            impacts = dataset.capture(name).impacts
            if paper is None:
                found.append(KnownObject(name, materials[name], impacts, extract_modes(impacts)))
            else:
                found.append(paper.object(name, materials[name], impacts))
    return tuple(found)


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

    def struck(
        self, material: Material, *, size: float = 1.0, sample_rate: float = 44100.0, seconds: float = 0.5
    ) -> KnownObject:
        """Return the object in a material and size, struck at places far apart, straight into its surface."""
        elastic = self.remade(material, size=size)
        vibration = damped(
            elastic.frequency, torch.diag(rayleigh(elastic.frequency, material)), highest=HIGHEST * sample_rate
        )
        middle = 0.5 * (elastic.nodes.amax(0) + elastic.nodes.amin(0))
        sound = radiated(elastic, vibration, middle + torch.tensor(_MICROPHONE, dtype=torch.float64))
        body = SoundingBody(elastic, vibration, sound, Hammer())
        places = elastic.nodes[self._spread[:_CONTACTS]]
        directions = -elastic.normals(places)
        amplitudes = body.gains(places, directions)
        starts, samples = torch.zeros(len(places), dtype=torch.float64), round(seconds * sample_rate)
        sounds = recorded(vibration.poles, amplitudes, starts, sample_rate=sample_rate, samples=samples)
        impacts = Impacts(
            contacts=places,
            sounds=sounds.float(),
            sample_rate=sample_rate,
            names=tuple(f"{row + 1:03d}.wav" for row in range(len(places))),
            directions=directions.float(),
        )
        bank = ModalBank(vibration.frequency, vibration.damping)
        # Regression over shapes needs some doubt: as much as noise 60 dB below the sounds would give.
        level = torch.full((17,), 1e-3 * float(sounds.square().mean().sqrt()))
        modes = Extraction(bank, -amplitudes.imag.float(), Residual(level), amplitudes.real.float())
        bodies = NominalBodies((NominalBody(None, elastic),), {})
        recipe = MixtureEstimator(bodies=CandidateBodies(bodies))
        features = partial(FeatureField.from_points, elastic.nodes[self._spread])
        return KnownObject(f"{self.kind}-{material.name}", material.name, impacts, modes, recipe, features)

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


def amplitudes_of(field: SoundField, contacts: Float64[Tensor, "contacts 3"]) -> Tensor:
    """Return the complex amplitudes of a field's modes at contacts, for `audible_modes`."""
    known = field.known(contacts)
    quadrature = torch.zeros_like(known.mean) if known.quadrature is None else known.quadrature
    return torch.complex(known.mean.double(), quadrature.double())
