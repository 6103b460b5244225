"""Options of `avmsf splat`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import parse_options
from avmsf.cli.options.paths import NewFile
from avmsf.cli.options.scenes import SceneOptions
from avmsf.gaussians.config import SplatConfig
from avmsf.pipeline.config import ViewsConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Fit 3D Gaussians to photographs, a video or a mesh, as a .ply file that any 3DGS viewer opens.

    Views and Gaussians are cached. Repeat an interrupted command to continue it.
    --seed is the seed of all stages.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="CLOUD.ply"), NewFile((".ply",))] = None
    """Copy the Gaussians to this file."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made."""
    config: Annotated[tyro.conf.OmitArgPrefixes[SplatConfig], tyro.conf.arg(name="Gaussians")] = field(
        default_factory=SplatConfig
    )
    """How Gaussians are fitted."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "splat", words)
