"""What is measured on: plates struck here, recordings where they lie, simulated objects, and splits of each."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import NormalDist
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.onset import find_second_push
from avmsf.capture.prepare import prepare
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.data import along_phase
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.fit import splat
from avmsf.gaussians.ply import read_splats, write_splats
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import turned_like
from avmsf.photographs import read_views
from avmsf.photographs.cameras import View
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.reconstruction import ObjectShape
from avmsf.simulate import recipe
from avmsf.simulate.ground_truth import Truth, read_truth
from avmsf.simulate.recipe import EXAMPLE_FOLDER, ObjectRecipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulation_folder import example_mesh, simulate_set
from avmsf.symmetry.characters import groups_of
from avmsf.symmetry.find import find_symmetries
from avmsf.symmetry.symmetries import Symmetries
from benchmarks.records import REPOSITORY, MissingDataError, Settings
from tests.oracles.plate import Plate, plate_surface_points, strike

STARTS = (0, 18, 37)
"""First contacts of the splits of a measured capture, as far as it has so many."""
COUNTS = {
    "aircraft_response": (8, 15, 28), "ruler10": (5, 7), "tree43": (12, 20, 40),
    "strip30": (6, 10, 15), "strip30_shaker": (6, 10, 15),
}  # fmt: skip
"""Training contacts of each measured capture."""
ROUGH = 0.003
"""Standard deviation of a noisy mesh's vertices along each axis, over the object's size."""
QUICK_FIT = FitConfig(warmup_steps=20, steps=2, damping="shared")
_POINTS = 8192
"""Points of an object that the gain field looks contacts up in."""
_BEFORE_NEXT_SECONDS = 0.002
"""How long before the next push's rise past 15 % of the first a clip is cut."""
SHARED = (REPOSITORY / os.environ.get("AVMSF_SHARED", "../shared")).resolve() / "data"
"""Measured data: `data` in what AVMSF_SHARED names."""
SCANS = {
    name: ObjectRecipe(mesh=SHARED / "meshes" / name / "textured.obj", material=material)
    for name, material in (
        ("blue_cup", "ceramic"), ("bowl", "steel"), ("mini_claw_hammer_1", "steel"), ("mug", "ceramic"),
        ("plate_holder", "wood"), ("spoon", "steel"),
    )
}  # fmt: skip
"""Six scans of household objects. All have both sides of their walls, and so are solid bodies: of no stated wall."""
SETS = recipe.SETS | {"scans": SCANS}
"""Recipes of the sets of simulated objects."""
TIDY = {"speed": 0.15, "contact_time": 0.0, "pretrigger": 0.0, "jitter": 0.0, "propagation": 0.0}


@dataclass(frozen=True, eq=False)
class PlateCase:
    """A plate and what strikes it."""

    plate: Plate
    contact_time: float
    """How long the hammer's tip pushes, seconds; 0 is an ideal impulse."""

    def strikes(
        self,
        count: int,
        *,
        seconds: float,
        noise_db: float = -40.0,
        sample_rate: float = 44100.0,
        highest: float = 8000.0,
    ) -> Impacts:
        """Return impacts at contacts drawn with seed 0; the noise comes from the same generator."""
        return strike(
            self.plate,
            count,
            sample_rate=sample_rate,
            seconds=seconds,
            seed=0,
            noise_db=noise_db,
            highest=highest,
            contact_time=self.contact_time,
        )

    def features(self) -> FeatureField:
        """Return the plate's surface, with positions as features."""
        return FeatureField.from_points(plate_surface_points(self.plate, _POINTS))


STRUCK = PlateCase(Plate(thickness=0.004), contact_time=5e-4)
"""A 4 mm plate struck with a hammer's tip."""
IMPULSE = PlateCase(Plate(), contact_time=0.0)
"""A 2 mm plate and an ideal impulse: 43 modes of equal strength, more than 20 impacts can resolve."""


def shared_data() -> Path:
    """Return the folder of measured data."""
    if not SHARED.is_dir():
        raise MissingDataError(f"no measured data at {SHARED}: set AVMSF_SHARED to the folder that holds data/")
    return SHARED


def settings_of(name: str) -> CaptureSettings:
    """Return the settings of a measured capture in `benchmarks/captures`."""
    return CaptureSettings.read(REPOSITORY / "benchmarks" / "captures" / f"{name}.toml")


def measured(name: str, settings: CaptureSettings | None = None) -> Capture:
    """Read a measured capture, with default settings unless others are given."""
    return read_capture(shared_data() / name, settings or CaptureSettings())


def example_capture() -> Capture:
    """Read the built-in example, and give it the mesh that it was simulated from."""
    return replace(read_capture(EXAMPLE_FOLDER), surface=example_mesh().surface)


def clips_in_place(name: str, *, highpass: float = 0.0) -> dict[str, tuple[Float[Tensor, " samples"], float]]:
    """Read clips without contacts: the first impact of each by name, up to the next one, and its sample rate in Hz.

    Without what lies below `highpass` Hz.
    """
    settings = replace(settings_of(name), highpass=highpass)
    clips = {}
    for path in sorted((shared_data() / name).glob("*.wav")):
        recording = read_recording(path)
        prepared, rate = prepare(recording, settings), recording.sample_rate
        seconds = settings.kept_seconds(rate)
        end = round(seconds * rate)
        if settings.force_channel is not None and prepared.pulse is not None:
            force = recording.channel(settings.force_channel)
            pushed = find_second_push(force, prepared.pulse, sample_rate=rate, seconds=seconds)
            if pushed is not None:
                end = pushed - prepared.onset - round(_BEFORE_NEXT_SECONDS * rate)
        clips[path.stem] = torch.from_numpy(prepared.sound[:end].copy()).float(), rate
    if not clips:
        raise MissingDataError(f"no wav files in {shared_data() / name}")
    return clips


def simulated(name: str, settings: Settings, imperfections: Mapping[str, float] | None = None) -> tuple[Capture, Truth]:
    """Return an object of `SETS` and its truth, from its folder, or simulated now with other imperfections."""
    if imperfections is None:
        folder = simulated_folder(name, settings)
        return read_capture(folder), read_truth(folder)
    made = SETS[_set_of(name)][name]
    made = replace(made, imperfections=replace(made.imperfections, **imperfections))
    simulation = simulate_object(made, name=name)
    return simulation.capture, simulation.truth


def simulated_folder(name: str, settings: Settings) -> Path:
    """Return the folder of an object of `SETS` with its pictures, simulated now where it does not exist."""
    of = _set_of(name)
    simulate_set({name: SETS[of][name]}, settings.kept / of)
    return settings.kept / of / name


def _set_of(name: str) -> str:
    found = [of for of, recipes in SETS.items() if name in recipes]
    if not found:
        raise MissingDataError(
            f"no object {name!r}; there are {', '.join(each for of in SETS.values() for each in of)}"
        )
    return found[0]


def views_and_gaussians(name: str, settings: Settings) -> tuple[tuple[View, ...], GaussianCloud]:
    """Return the photographs of a simulated object and its Gaussians."""
    config = replace(SplatConfig(), steps=200) if settings.quick else SplatConfig()
    views = read_views(simulated_folder(name, settings))
    path = settings.kept / "gaussians" / f"{name}-{config.steps}-steps.ply"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_splats(splat(views, config), path)
    return tuple(views), read_splats(path)


def surface_of(capture: Capture) -> Surface:
    """Return the surface of a capture that has one."""
    assert capture.surface is not None
    return capture.surface


def features_of(capture: Capture) -> FeatureField:
    """Return points drawn with seed 0 from a capture's surface, or its contacts, with positions as features."""
    if capture.surface is None:
        return FeatureField.from_contacts(capture.impacts.contacts)
    return FeatureField.from_mesh(capture.surface, seed=0, count=_POINTS)


def bodies_of(
    surface: Surface | ObjectShape, settings: Settings, supports: Literal["auto", "try"] = "auto"
) -> CandidateBodies:
    """Return the bodies of unknown thickness behind a surface, coarse for a quick look."""
    config = BodyConfig(shapes=12, dofs=7000) if settings.quick else BodyConfig()
    return candidate_bodies(surface, replace(config, supports=supports))


def solid_estimator(surface: Surface, settings: Settings) -> MixtureEstimator:
    """Return the gain models' estimator for a solid body with this surface, coarse for a quick look."""
    shapes, dofs = (12, 20_000) if settings.quick else (60, 40_000)
    return MixtureEstimator(bodies=CandidateBodies(surface, thicknesses=[None], count=shapes, dofs=dofs))


@dataclass(frozen=True, eq=False)
class SplitCase:
    """One split of one object."""

    train: Impacts
    test: Impacts
    modes: Extraction
    features: FeatureField
    bodies: CandidateBodies | None = None
    surface: Surface | None = None

    @classmethod
    def of(cls, train: Impacts, test: Impacts, capture: Capture, bodies: CandidateBodies | None = None) -> "SplitCase":
        """Extract the modes of the training impacts, and align all with them."""
        modes = extract_modes(train)
        features = features_of(capture)
        return cls(modes.aligned(train), modes.aligned(test), modes, features, bodies, capture.surface)

    def fit(self, estimator: MixtureEstimator, *, quick: bool = False) -> SoundField:
        """Return the field of an estimator, refined unless it should be quick."""
        config = FitConfig(warmup_steps=0, steps=1 if quick else FitConfig().steps)
        return fit(self.train, self.features, self.modes, config, gains=estimator)

    @cached_property
    def symmetries(self) -> Symmetries | None:
        """Of the mesh's points; None without a mesh, or where they have none."""
        if self.surface is None:
            return None
        found = find_symmetries(self.features.points, seed=0)
        return found if groups_of(found) else None

    def error(self, field: SoundField) -> float:
        """Return the relative STFT error at the held-out contacts."""
        return evaluate(field, self.test).mean()["relative_stft"]

    def coverage(self, field: SoundField) -> tuple[float, float]:
        """Return the part of the held-out gains in their intervals of 90 %, and that by energy.

        Intervals are normal, of a measured gain; each mode's phase, which all contacts share, is free.
        """
        model = field.fitted_mixture
        known = model.posterior(self.test.contacts, self.test.directions)
        assert known.std is not None
        gains = fit_gains(self.test.sounds.double(), field.bank, sample_rate=field.sample_rate)
        gains = turned_like(along_phase(gains, field.phase), known.mean.to(torch.complex128))
        spread = (known.std.double().square() + model.noise().square()).sqrt()
        within = (torch.view_as_real(gains) - known.parts).abs() <= NormalDist().inv_cdf(0.95) * spread
        energy = torch.view_as_real(model.values).square().mean(0) / field.bank.damping[:, None]
        return float(within.double().mean()), float((within * energy).sum(0).sum() / (len(within) * energy.sum()))


def roughened(surface: Surface, part: float, *, seed: int) -> Surface:
    """Return a surface whose vertices are displaced at random, by `part` of its size (standard deviation, each axis).

    The size is the diagonal of the box around it: what a bad scan does to a shape.
    """
    generator = np.random.default_rng(seed)
    size = float((surface.vertices.amax(0) - surface.vertices.amin(0)).norm())
    moved = surface.vertices.double().numpy() + part * size * generator.standard_normal(surface.vertices.shape)
    return Surface(torch.from_numpy(moved).to(surface.vertices.dtype), surface.faces)


def splits_of(capture: Capture, count: int, bodies: CandidateBodies | None, settings: Settings) -> Iterator[SplitCase]:
    """Yield the splits of a measured capture."""
    for start in settings.some([start for start in STARTS if start < len(capture.impacts)]):
        yield SplitCase.of(*split(capture.impacts, count, start=start), capture, bodies)
