"""Settings that the methods of an evaluation share: importing this imports nothing that computes."""

from dataclasses import dataclass, field
from typing import Literal

from avmsf.gaussians.config import SplatConfig
from avmsf.modal.config import ExtractionMethod, expect_modes
from avmsf.pipeline.config import BodyConfig, Geometry, LiftConfig


@dataclass(frozen=True)
class EvaluationSettings:
    """What methods share."""

    geometry: Geometry = "mesh"
    """Shape that finite elements use. mesh: the object's mesh. gaussians: the surface of Gaussians fitted to its views.
    noisy: its mesh with vertices displaced by 2 % of its size."""
    amplitude_scale: Literal["full-scale", "raw"] = "full-scale"
    """full-scale: an object's sounds times one factor that brings its loudest recording to a peak of one, so that
    values of different objects can be averaged. raw: in the recordings' unit."""
    extraction: ExtractionMethod = "high-resolution"
    """How the modes that methods share are extracted; see `avmsf modes --help`. The methods `paper` have their own."""
    modes: int = 128
    """Maximum number of the modes that methods share."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made. The methods `paper` use the paper's own settings and only the encoder given here: DINOv2
    without `lift.encoder`, which then has to be installed."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Elastic bodies."""

    def __post_init__(self) -> None:
        expect_modes(self.modes)
