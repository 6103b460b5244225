"""Options of the commands that start from photographs, a video, a mesh or Gaussians."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.capture.filenames import expect_views
from avmsf.capture.settings import CaptureSettings
from avmsf.cli.options.checks import expect_device, read_settings
from avmsf.cli.options.common import Printing
from avmsf.cli.options.paths import CacheFolder, Existing, SettingsFile
from avmsf.errors import SceneError
from avmsf.pipeline.config import CACHE, SceneConfig


@dataclass(frozen=True)
class SceneOptions(Printing):
    """The input, and the cache of the stages' outputs."""

    folder: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="FOLDER"),
            Existing("a folder with photographs, a video or a mesh", ("a folder",)),
        ]
    ]
    """Folder with photographs (transforms.json, a COLMAP model, or only images/), a video, a mesh or Gaussians."""
    cache: CacheFolder = None
    """Cache the output of each stage here, by default in FOLDER/.avmsf."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device for Gaussians (with gsplat), DINOv2 and training; by default the GPU if there is one."""

    def check_inputs(self) -> None:
        """Raise the package's errors for a folder that shows nothing of the object, and an unknown device."""
        super().check_inputs()
        expect_device(self.device, raising=SceneError)
        self.expect_folder(read_settings(self.folder, self.settings))

    def expect_folder(self, settings: CaptureSettings) -> None:
        """Raise `SceneError` for a folder that shows nothing of the object."""
        expect_views(self.folder, settings)

    @property
    def kept(self) -> Path:
        """The folder that caches the stages' outputs."""
        return self.folder / CACHE if self.cache is None else self.cache


def with_seed(config: SceneConfig, seed: int | None) -> SceneConfig:
    """Return the settings with one seed for all stages; unchanged for None."""
    if seed is None:
        return config
    parts = {name: replace(getattr(config, name), seed=seed) for name in ("views", "splat", "lift")}
    return replace(config, **parts)
