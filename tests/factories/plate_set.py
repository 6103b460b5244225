"""A few small plates as a folder of captures, and features of them that take no time."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from avmsf.capture import Capture, write_capture
from avmsf.errors import SceneError, SimulationError
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.registry import VisualInput
from avmsf.features.feature_field import FeatureField
from avmsf.simulate.ground_truth import TRUTH, Truth, write_truth
from factories.plate_field import CONTACT_TIME, HIGHEST, plate_impacts, rectangle
from oracles.plate import Plate, plate_modes, plate_surface_points


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
        plate = plate_named(name)
        impacts = plate_impacts(count, seconds=0.25, plate=plate, seed=number)
        impacts = replace(impacts, names=tuple(map(recordings.format, range(count))))
        write_capture(Capture(name, impacts, rectangle(plate) if truth else None), folder / name)
        if truth:
            modes = plate_modes(plate, impacts.contacts, highest=HIGHEST, contact_time=CONTACT_TIME)
            known = Truth(modes.frequency, modes.damping, modes.gains + 0j, impacts.names)
            write_truth(known, folder / name / TRUTH)
    return folder


class PlateInputs(ObjectInputs):
    """Positions of a plate, and no looks and no shape."""

    def features(self, identifier: str, visual_input: VisualInput, views: int | None = None) -> FeatureField:
        if visual_input.form != "surface" and not visual_input.bare:
            raise SceneError(f"{identifier}: nothing shows its look")
        return FeatureField.from_points(plate_surface_points(plate_named(identifier), 200))

    def bodies(self, identifier: str) -> Any:
        raise SimulationError(f"{identifier} has no shape here")

    def cloud(self, identifier: str, views: int | None = None) -> Any:
        raise SceneError(f"{identifier}: nothing shows its look")

    family = bodies
