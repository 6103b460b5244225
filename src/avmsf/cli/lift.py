"""`avmsf lift`: features on an object's surface out of what a folder shows of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.capture.together import expect_one_unit
from avmsf.cli import INTERRUPTED
from avmsf.cli.printing import console, print_json, say
from avmsf.cli.scenebar import SceneBar
from avmsf.cli.scenes import SceneOptions, features_words, stage_line
from avmsf.cli.writing import expect_writable
from avmsf.files import copy_whole
from avmsf.pipeline.config import LiftConfig, SceneConfig, ViewsConfig
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.stages import StageFolder
from avmsf.scene.featurestore import read_report
from avmsf.scene.splatconfig import SplatConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Describe what each place of an object looks like, and make that obey the object's symmetries.

    Views and Gaussians are made first where the cache does not have them. `avmsf fit --features` reads the result.
    """

    output: Annotated[Path | None, tyro.conf.arg(metavar="FEATURES.safetensors")] = None
    """File to copy the features to."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    splat: SplatConfig = field(default_factory=SplatConfig)
    config: tyro.conf.OmitArgPrefixes[LiftConfig] = field(default_factory=LiftConfig)
    """Settings of the features."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf lift", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Make the features; return 130 where Ctrl-C stopped it."""
    if options.output is not None:
        expect_writable(options.output)
    settings = options.read_settings()
    expect_one_unit(options.folder, settings)
    stages = StageFolder(options.kept)
    try:
        with SceneBar() as bar:
            scene = SceneStages(
                options.folder,
                stages,
                SceneConfig(options.views, options.splat, options.config),
                settings=settings,
                listener=bar.listener,
            )
            scene.expect_any()
            with stages.lock("avmsf lift"):
                features = scene.features
                report = read_report(features.path)
                if options.output is not None:
                    copy_whole(features.path, options.output)
    except KeyboardInterrupt:
        say("avmsf lift: interrupted; the same command goes on from where it was")
        return INTERRUPTED
    screen = console(errors=options.json)
    screen.print(features_words(report), soft_wrap=True)
    for name, kept in scene.made().items():
        screen.print(stage_line(name, kept), soft_wrap=True)
    if options.output is not None:
        screen.print(f"wrote {options.output}", soft_wrap=True)
    if options.json:
        print_json({"features": str(options.output or features.path), **report})
    return 0
