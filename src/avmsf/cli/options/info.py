"""Options of `avmsf info`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.checks import expect_capture
from avmsf.cli.options.common import Printing
from avmsf.cli.options.paths import Existing, OtherCapture, PlotsFolder, SettingsFile, kind_of
from avmsf.field.header import FIELD
from avmsf.gaussians.ply_header import read_header


@dataclass(frozen=True)
class Options(Printing):
    """Describe a field, Gaussians or features, and draw them with --plots."""

    file: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="FILE"),
            Existing("a field, Gaussians or features", ("a sound field", "features", "a mesh or Gaussians")),
        ]
    ]
    """A field (.safetensors), Gaussians (.ply) or features (.safetensors), as `avmsf fit` writes them."""
    capture: OtherCapture = None
    """Field: compare it with a capture's recordings that it was not fitted to, or with all if there are none."""
    settings: SettingsFile = None
    """Field: use this capture.toml instead of the capture's own."""
    plots: PlotsFolder = None
    """Write figures to this folder. Field: modes.png, gains.png; uncertainty.png and spectrum.png if the gains have a
    posterior; surface.png, with cross-sections, if they have a body; spectrograms.png with --capture. Gaussians:
    cloud.png. Features: features.png."""
    cloud: Annotated[
        Path | None, tyro.conf.arg(metavar="CLOUD.ply"), Existing("Gaussians, as a .ply file", ("a mesh or Gaussians",))
    ] = None
    """Features: also draw the colors of the Gaussians that the features lie on."""
    up: Literal["x", "y", "z"] = "z"
    """Gaussians and features: axis that points up."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        suffix = self.file.suffix.lower()
        for cloud in (self.file if suffix == ".ply" else None, self.cloud):
            if cloud is not None:
                read_header(cloud)
        if suffix != ".ply" and kind_of(self.file) != "features":
            FIELD.read_record(self.file)
            if self.capture is not None:
                expect_capture(self.capture, self.settings)
