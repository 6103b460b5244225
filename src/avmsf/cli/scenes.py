"""What the verbs that turn a folder's look into features have in common."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from avmsf.capture import CaptureSettings
from avmsf.capture.folder import settings_of
from avmsf.pipeline.reconstruct import CACHE
from avmsf.pipeline.stages import Kept
from avmsf.scene.symmetry import Symmetries


@dataclass(frozen=True)
class SceneOptions:
    """Where a folder's look is read and its stages are kept."""

    folder: tyro.conf.Positional[Path]
    """Folder with photographs (transforms.json, a COLMAP model, or images/ alone), a video, a mesh or Gaussians."""
    cache: Path | None = None
    """Folder to keep each stage's output in, so that it need not be made again; FOLDER/.avmsf without it."""
    settings: Path | None = None
    """A capture.toml to use in place of the folder's own."""

    @property
    def kept(self) -> Path:
        """The folder of kept stages."""
        return self.folder / CACHE if self.cache is None else self.cache

    def read_settings(self) -> CaptureSettings:
        """Return the settings of the capture that the folder is, or the defaults."""
        return settings_of(self.folder) if self.settings is None else CaptureSettings.read(self.settings)


def stage_line(name: str, kept: Kept) -> str:
    """Say what a stage cost."""
    return f"{name:9} {kept.seconds:7.1f} s{'' if kept.fresh else ' (kept from before)'}  {kept.path}"


def features_words(report: Mapping[str, Any]) -> str:
    """Say what the features are, how sure of them the views are, and which symmetries they obey."""
    lines = [
        f"features: {report['encoder']}, on {report['points']} points, {report['unseen']} of which no view sees; views "
        f"agree on {100 * report['agreement']:.0f} % of the features' variance"
    ]
    if report.get("dropped"):
        lines.append(f"left out: {report['dropped']} Gaussians inside the object or behind its surface in the views")
    if "symmetries" in report:
        lines.append(Symmetries.from_dict(report["symmetries"]).summary())
    if "orbit_spread" in report:
        before, after = report["orbit_spread"]
        lines.append(f"spread over orbits, in the features' own spread: {before:.3f} before pooling, {after:.3f} after")
    return "\n".join(lines)
