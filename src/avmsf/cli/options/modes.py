"""Options of `avmsf modes`."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import tyro

from avmsf.cli.options.checks import expect_capture, expect_modes
from avmsf.cli.options.common import Printing, parse_options, preset_of, preset_values
from avmsf.cli.options.paths import CaptureFolder, PlotsFolder, SettingsFile
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import PipelineConfig, Preset, TimeZero


@dataclass(frozen=True)
class Options(Printing):
    """List the modes of an object: frequencies, dampings and levels, from all recordings of a capture."""

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    extraction: ExtractionMethod = "high-resolution"
    """How modes are extracted. high-resolution: ESPRIT in subbands, which separates modes a few hertz apart.
    short-time: the paper's method, bin by bin of a short-time spectrum."""
    modes: int = 128
    """Maximum number of modes."""
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
        expect_modes(self.modes)
        expect_capture(self.capture, self.settings)

    @property
    def pipeline(self) -> PipelineConfig:
        """The settings that modes depend on, with the defaults of all others."""
        return PipelineConfig(extraction=self.extraction, modes=self.modes, time_zero=self.time_zero)

    @classmethod
    def parse(cls, words: Sequence[str]) -> "Options":
        """Return the options that the words spell, with the preset's settings as defaults."""
        values = preset_values(preset_of(words))
        own = {name: values[name] for name in ("extraction", "modes", "time_zero", "preset")}
        return parse_options(partial(cls, **own), "modes", words)
