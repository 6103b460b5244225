"""What the benchmarks measure on: plates struck here, and recordings read where they lie."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.onset import find_second_push
from avmsf.capture.prepare import prepare
from avmsf.features.feature_field import FeatureField
from avmsf.simulate.recipe import EXAMPLE_FOLDER
from avmsf.simulate.simulation_folder import example_mesh
from tests.oracles.plate import Plate, plate_surface_points, sample_contacts, strike

REPOSITORY = Path(__file__).resolve().parents[1]
POINTS = 8192
"""Points of an object that the gain field looks contacts up in."""
_BEFORE_NEXT_BLOW = 0.002
"""How long before the next push's rise past 15 % of the first a clip is cut, seconds."""


class MissingDataError(Exception):
    """Measured data is not where it was looked for."""


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
        """Return blows at contacts drawn with seed 0; the noise comes from the same generator."""
        generator = torch.Generator().manual_seed(0)
        contacts = sample_contacts(self.plate, count, generator=generator)
        return strike(
            self.plate,
            contacts,
            sample_rate=sample_rate,
            seconds=seconds,
            generator=generator,
            noise_db=noise_db,
            highest=highest,
            contact_time=self.contact_time,
        )

    def features(self) -> FeatureField:
        """Return the plate's surface, with positions as features."""
        return FeatureField.from_points(plate_surface_points(self.plate, POINTS))


STRUCK = PlateCase(Plate(thickness=0.004), contact_time=5e-4)
"""A 4 mm plate struck with a hammer's tip."""
IMPULSE = PlateCase(Plate(), contact_time=0.0)
"""A 2 mm plate and an ideal impulse: 43 modes of equal strength, more than 20 taps can resolve."""


@dataclass(frozen=True, eq=False)
class Clip:
    """One blow, from its onset on."""

    name: str
    sound: Float[Tensor, " samples"]
    sample_rate: float
    """Hz."""


def shared_data() -> Path:
    """Return the folder of measured data: `data` in what AVMSF_SHARED names, by default ../shared."""
    folder = (REPOSITORY / os.environ.get("AVMSF_SHARED", "../shared")).resolve() / "data"
    if not folder.is_dir():
        raise MissingDataError(
            f"no measured data at {folder}: set AVMSF_SHARED to the folder that holds data/, or choose --parts that "
            "need none"
        )
    return folder


def capture_in_place(name: str) -> Capture:
    """Read a capture of measured data with the settings in `benchmarks/captures`."""
    return read_capture(shared_data() / name, _settings(name))


def example_capture() -> Capture:
    """Read the built-in example, and give it the mesh that it was simulated from."""
    return replace(read_capture(EXAMPLE_FOLDER), surface=example_mesh().surface)


def surface_features(capture: Capture) -> FeatureField:
    """Return points drawn with seed 0 from a capture's surface, with positions alone as features."""
    assert capture.surface is not None
    return FeatureField.from_mesh(capture.surface, seed=0, count=POINTS)


def clips_in_place(name: str, *, highpass: float = 0.0) -> list[Clip]:
    """Read a folder of clips without contacts: of each the first blow, up to the next one or `seconds` long.

    Without what lies below `highpass` Hz.
    """
    settings = replace(_settings(name), highpass=highpass)
    clips = []
    for path in sorted((shared_data() / name).glob("*.wav")):
        recording = read_recording(path)
        prepared, rate = prepare(recording, settings), recording.sample_rate
        end = round(settings.kept_seconds(rate) * rate)
        if settings.force_channel is not None and prepared.pulse is not None:
            force = recording.channel(settings.force_channel)
            pushed = find_second_push(force, prepared.pulse, sample_rate=rate, seconds=settings.kept_seconds(rate))
            if pushed is not None:
                end = pushed - prepared.onset - round(_BEFORE_NEXT_BLOW * rate)
        clips.append(Clip(path.stem, torch.from_numpy(prepared.sound[:end].copy()).float(), rate))
    if not clips:
        raise MissingDataError(f"no wav files in {shared_data() / name}")
    return clips


def _settings(name: str) -> CaptureSettings:
    return CaptureSettings.read(REPOSITORY / "benchmarks" / "captures" / f"{name}.toml")
