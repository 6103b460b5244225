"""Options of `avmsf features`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import parse_options, preset_of
from avmsf.cli.options.paths import NEW_TENSORS
from avmsf.cli.options.scenes import SceneOptions
from avmsf.gaussians.config import SplatConfig
from avmsf.pipeline.config import PRESETS, LiftConfig, Preset, ViewsConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Compute visual features on an object's surface, equal at points that are symmetric to each other.

    Views and Gaussians are made first if the cache does not have them. `avmsf fit --features` reads the result.
    --seed is the seed of all stages.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FEATURES.safetensors"), NEW_TENSORS] = None
    """Copy the features to this file."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""
    preset: Preset = "default"
    """Defaults of all settings; paper: features as published. `--preset paper --help` shows its values."""
    config: Annotated[tyro.conf.OmitArgPrefixes[LiftConfig], tyro.conf.arg(name="features")] = field(
        default_factory=LiftConfig
    )
    """How features are made."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell, with the preset's settings as defaults."""
    preset = preset_of(words)
    scene = PRESETS[preset].scene
    defaults = partial(Options, preset=preset, views=scene.views, splat=scene.splat, config=scene.lift)
    return parse_options(defaults, "features", words)
