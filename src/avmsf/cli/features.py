"""`avmsf features`: features on an object's surface from a folder's views of it."""

import shlex

from avmsf._utils.files import copy_whole
from avmsf.cli import INTERRUPTED
from avmsf.cli.options.features import Options
from avmsf.cli.options.scenes import with_seed
from avmsf.cli.printing import console, next_command, print_json, say
from avmsf.cli.scenes import features_words, opened_scene, stage_line
from avmsf.features.store import read_report
from avmsf.pipeline.config import SceneConfig


def run(options: Options) -> int:
    """Make the features; return 130 where Ctrl-C stopped it."""
    config = with_seed(SceneConfig(options.views, options.splat, options.config), options.config.seed or None)
    try:
        with opened_scene(options, config, command="avmsf features") as scene:
            features = scene.features
            report = read_report(features.path)
            if options.output is not None:
                copy_whole(features.path, options.output)
    except KeyboardInterrupt:
        say("avmsf features: interrupted; repeat the command to continue")
        return INTERRUPTED
    screen = console(errors=options.json)
    screen.print(features_words(report), soft_wrap=True)
    for name, kept in scene.made().items():
        screen.print(stage_line(name, kept), soft_wrap=True)
    if options.output is not None:
        screen.print(f"wrote {options.output}", soft_wrap=True)
    if options.json:
        print_json({"features": str(options.output or features.path), **report})
    made = shlex.quote(str(options.output or features.path))
    model = "--preset paper" if options.preset == "paper" else "--gain-model visual"
    next_command("avmsf fit", options.folder, f"--features {made} {model} -o field.safetensors")
    return 0
