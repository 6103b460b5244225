"""Options of `avmsf surface`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, get_args

import tyro

from avmsf.cli.options.common import parse_options
from avmsf.cli.options.paths import NewFile, PlotsFolder
from avmsf.cli.options.scenes import SceneOptions
from avmsf.gaussians.config import SplatConfig
from avmsf.mesh.surface import SurfaceKind
from avmsf.pipeline.config import ViewsConfig

_KINDS: tuple[SurfaceKind, ...] = get_args(SurfaceKind)
_SUFFIXES = tuple(f".{kind}" for kind in _KINDS)


@dataclass(frozen=True)
class Options(SceneOptions):
    """Write an object's surface as a mesh: the folder's own, or one reconstructed from its views.

    In meters and in the frame of the folder. Both sides of a wall and the depth of cavities are reconstructed as far as
    views show them. `avmsf reconstruct` uses this surface as one of its candidate bodies; the others have walls of
    several thicknesses below its outer side, since views do not show the thickness. Views and Gaussians are made first
    if the cache does not have them.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="SURFACE.ply"), NewFile(_SUFFIXES)] = None
    """Write the surface to this file, which ends in .ply, .obj or .glb; surface.ply in the cache is always written."""
    plots: PlotsFolder = None
    """Draw the surface and two cross-sections to surface.png in this folder."""
    seed: int | None = None
    """Seed of all stages; by default each stage's own."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""

    @property
    def kind(self) -> SurfaceKind:
        """The format of the output, ply without one."""
        return "ply" if self.output is None else _KINDS[_SUFFIXES.index(self.output.suffix.lower())]


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "surface", words)
