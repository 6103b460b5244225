"""Options of `avmsf modes`."""

from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from avmsf.cli.options.checks import expect_capture
from avmsf.cli.options.common import Printing
from avmsf.cli.options.paths import CaptureFolder, PlotsFolder, SettingsFile
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import PRESETS, PipelineConfig, Preset, TimeZero


@dataclass(frozen=True)
class Options(Printing):
    """List the modes of an object: frequencies, dampings and levels, from all recordings of a capture."""

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    extraction: ExtractionMethod | None = None
    """How modes are extracted, by default high-resolution: ESPRIT in subbands, which separates modes a few hertz apart.
    short-time: the paper's method, bin by bin of a short-time spectrum."""
    modes: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Maximum number of modes, by default 128."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    preset: Preset = "default"
    """Defaults of all settings; paper: the published method, from the peak on."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    plots: PlotsFolder = None
    """Draw the modes to modes.png in this folder."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        _ = self.pipeline
        expect_capture(self.capture, self.settings)

    @property
    def pipeline(self) -> PipelineConfig:
        """The settings of the preset, with those that are given."""
        names = ("extraction", "modes", "time_zero")
        given = {name: value for name in names if (value := getattr(self, name)) is not None}
        return replace(PRESETS[self.preset], **given)
