"""A few small plates as a folder of captures, and features of them that take no time."""

from dataclasses import replace
from pathlib import Path

import torch

from avmsf.baselines.diffsound.body_family import BodyFamily
from avmsf.capture import Capture, write_capture
from avmsf.errors import SceneError, SimulationError
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.task import VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBodies
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.mesh import Surface
from avmsf.simulate.ground_truth import TRUTH, Truth, write_truth
from oracles.plate import Plate, plate_modes, plate_surface_points, sample_contacts, strike

RATE, HIGHEST = 8000.0, 2500.0


def plate_named(name: str) -> Plate:
    return Plate(alpha=40.0, thickness=0.002 + 0.0004 * (sum(name.encode()) % 5))


def fill_plates(
    folder: Path,
    names: tuple[str, ...] = ("a", "b", "c"),
    *,
    count: int = 10,
    truth: bool = False,
    recordings: str = "{:02d}.wav",
) -> Path:
    """Write captures of plates; with `truth`, as simulated objects have it, and a surface to be seen.

    `recordings` makes a recording's name from its row.
    """
    for number, name in enumerate(names):
        generator = torch.Generator().manual_seed(number)
        plate = plate_named(name)
        impacts = strike(
            plate,
            sample_contacts(plate, count, generator=generator),
            sample_rate=RATE,
            seconds=0.25,
            generator=generator,
            noise_db=-40.0,
            highest=HIGHEST,
            contact_time=5e-4,
        )
        impacts = replace(impacts, names=tuple(map(recordings.format, range(count))))
        write_capture(Capture(name, impacts, _surface(plate) if truth else None), folder / name)
        if truth:
            modes = plate_modes(plate, impacts.contacts, highest=HIGHEST, contact_time=5e-4)
            known = Truth(modes.frequency, modes.damping, modes.gains + 0j, impacts.names)
            write_truth(known, folder / name / TRUTH)
    return folder


def _surface(plate: Plate) -> Surface:
    a, b = plate.length, plate.width
    corners = torch.tensor([[0.0, 0.0, 0.0], [a, 0.0, 0.0], [a, b, 0.0], [0.0, b, 0.0]])
    return Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))


class PlateInputs(ObjectInputs):
    """Positions of a plate, and no looks and no shape."""

    def __init__(self) -> None:
        """Read no dataset."""

    def __repr__(self) -> str:
        return "PlateInputs()"

    def features(self, identifier: str, visual_input: VisualInput, views: int | None = None) -> FeatureField:
        if visual_input not in ("surface", "positions"):
            raise SceneError(f"{identifier}: nothing shows its look")
        return FeatureField.from_points(plate_surface_points(plate_named(identifier), 200))

    def bodies(self, identifier: str) -> CandidateBodies:
        raise SimulationError(f"{identifier} has no shape here")

    def family(self, identifier: str) -> BodyFamily:
        raise SimulationError(f"{identifier} has no shape here")

    def cloud(self, identifier: str, views: int | None = None) -> GaussianCloud:
        raise SceneError(f"{identifier}: nothing shows its look")
