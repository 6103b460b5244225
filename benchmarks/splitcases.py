"""Splits of measured and simulated objects that several benchmarks of gain models share."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.errors import CaptureWarning
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.splits import split
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.data import along_phase
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.posterior import coverage
from avmsf.field.sound_field import SoundField
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import Extraction, extract_modes
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.pipeline.bodies import candidate_bodies
from avmsf.pipeline.config import BodyConfig
from avmsf.reconstruction import ObjectShape
from avmsf.simulate.ground_truth import Truth, read_truth
from avmsf.simulate.recipe import named_recipe
from avmsf.simulate.simulation import simulate_object
from avmsf.symmetry.characters import groups_of
from avmsf.symmetry.find import find_symmetries
from avmsf.symmetry.symmetries import Symmetries
from benchmarks.material import shared_data, surface_features
from benchmarks.report import Options, log

STARTS = (0, 18, 37)
COUNTS = {
    "aircraft_response": (8, 15, 28), "ruler10": (5, 7), "tree43": (12, 20, 40),
    "strip30": (6, 10, 15), "strip30_shaker": (6, 10, 15),
}  # fmt: skip
"""Training places of each measured capture."""
ROUGH = 0.003
"""Standard deviation of a noisy mesh's vertices along each axis, over the object's size."""
_TIDY = {"speed": 0.15, "contact_time": 0.0, "pretrigger": 0.0, "jitter": 0.0, "propagation": 0.0}


@dataclass(frozen=True, eq=False)
class SplitCase:
    """One split of one object."""

    train: Impacts
    test: Impacts
    modes: Extraction
    features: FeatureField
    bodies: CandidateBodies | None
    surface: Surface | None

    def fit(self, estimator: MixtureEstimator, *, quick: bool) -> SoundField:
        """Return the field of an estimator, refined unless it should be quick."""
        steps = 1 if quick else FitConfig().steps
        config = FitConfig(warmup_steps=0, steps=steps)
        return fit(self.train, self.features, self.modes, config, gains=estimator)

    @cached_property
    def symmetries(self) -> Symmetries | None:
        """Of the mesh's points; None without a mesh, or where they have none."""
        if self.surface is None:
            return None
        found = find_symmetries(self.features.points, seed=0)
        return found if groups_of(found) else None

    def coverage(self, field: SoundField) -> float:
        """Return the part of the held-out gains, by energy, in their intervals of 90 %."""
        gains = along_phase(fit_gains(self.test.sounds, field.bank, sample_rate=field.sample_rate), field.phase)
        return coverage(field, self.test.contacts, gains, directions=self.test.directions).by_energy

    def error(self, field: SoundField) -> float:
        """Return the relative STFT error at the held-out contacts."""
        return evaluate(field, self.test).mean()["relative_stft"]


def splits_of(capture: Capture, count: int, bodies: CandidateBodies | None, options: Options) -> Iterator[SplitCase]:
    """Yield the splits of a capture."""
    starts = [start for start in STARTS if start < len(capture.impacts)]
    for start in starts[:1] if options.quick_look else starts:
        yield split_case(*split(capture.impacts, count, start=start), capture, bodies)


def split_case(train: Impacts, test: Impacts, capture: Capture, bodies: CandidateBodies | None) -> SplitCase:
    modes = extract_modes(train)
    contacts = capture.impacts.contacts
    features = FeatureField.from_contacts(contacts) if capture.surface is None else surface_features(capture)
    return SplitCase(modes.aligned(train), modes.aligned(test), modes, features, bodies, capture.surface)


def bodies_of(surface: Surface | ObjectShape, options: Options) -> CandidateBodies:
    config = BodyConfig(shapes=12, dofs=3000) if options.quick_look else BodyConfig()
    return candidate_bodies(surface, config, log=log)


def measured(name: str) -> Capture:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        return read_capture(shared_data() / name, CaptureSettings())


def simulated(name: str, options: Options, cache: Path, *, tidy: bool = False) -> tuple[Capture, Truth]:
    """Return an object of the set and its truth, from the folder or simulated now.

    A tidy one has recordings that start with their impacts and impacts of nearly one speed: without what the set got
    when recordings began to be aligned.
    """
    if options.sim20 is not None and not tidy:
        return read_capture(options.sim20 / name), read_truth(options.sim20 / name)
    recipe = named_recipe(name)
    if tidy:
        recipe = replace(recipe, imperfections=replace(recipe.imperfections, **_TIDY))
    made = simulate_object(recipe, name=name, cache=cache)
    return made.capture, made.truth
