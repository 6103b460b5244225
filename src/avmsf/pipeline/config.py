"""One configuration for the whole way from views and recordings to a field, and the presets."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from avmsf.capture.settings import CaptureSettings
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.gains.estimator import GainModel
from avmsf.field.soundfield import SoundField
from avmsf.modal.extraction.finders import ExtractionMethod, ModeFinder, finder_named
from avmsf.pipeline.bodies import BodyConfig
from avmsf.pipeline.features import DINO, LiftConfig
from avmsf.pipeline.scene import SceneConfig

Preset = Literal["default", "paper"]
TimeZero = Literal["onset", "peak"]
RECORD = "pipeline"
"""What a field's report calls the configuration that made it."""


@dataclass(frozen=True)
class PipelineConfig:
    """Settings of all stages."""

    gain_model: GainModel = "auto"
    """How gains vary over the object."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """How the object's shape becomes bodies that vibrate."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How views, Gaussians and features are made."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How the field is fitted."""
    method: ExtractionMethod = "high-resolution"
    """How modes are found."""
    modes: int = 128
    """Most modes to keep."""
    time_zero: TimeZero | None = None
    """Where sounds start; None leaves that to the capture's settings."""
    device: str | None = None
    """What computes: cpu or cuda; None takes the GPU where there is one. Training gives the same up to rounding,
    Gaussians do not; stages that are kept are used whichever device made them."""

    @property
    def finder(self) -> ModeFinder:
        """What finds the modes."""
        return finder_named(self.method, self.modes)

    def capture_settings(self, settings: CaptureSettings) -> CaptureSettings:
        """Return a capture's settings with this configuration's start of sounds."""
        return settings if self.time_zero is None else replace(settings, time_zero=self.time_zero)


PRESETS: Mapping[Preset, PipelineConfig] = {
    "default": PipelineConfig(),
    "paper": PipelineConfig(
        gain_model="network",
        scene=SceneConfig(
            lift=LiftConfig(
                encoder=DINO,
                background="kept",
                weighting="plain",
                components=0,
                reach=0.0,
                positions=False,
                onto="gaussians",
            )
        ),
        fit=PAPER,
        method="short-time",
        time_zero="peak",
    ),
}
"""`paper` has every stage as published, and of each published list the middle value; docs/paper-map.md lists what the
paper leaves open."""


def with_record(made: SoundField, config: PipelineConfig, features: Mapping[str, Any]) -> SoundField:
    """Return a field whose report has the configuration that made it, but for the fit's own, which it has anyway.

    `features` is the report of the features' file: it names the encoder that was taken and how the features were made,
    which decide where `config.scene` does not, as for a file from elsewhere. Empty where there is none.
    """
    values = asdict(config)
    del values["fit"]
    values["scene"] = features.get("scene")
    values["encoder"] = features.get("encoder")
    report = {**made.origin.report, RECORD: values}
    return replace(made, origin=replace(made.origin, report=report))
