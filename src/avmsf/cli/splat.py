"""`avmsf splat`: a folder's photographs, video or mesh in, Gaussians out."""

from avmsf._utils.files import copy_whole
from avmsf._utils.wording import counted
from avmsf.cli import INTERRUPTED
from avmsf.cli.options.scenes import with_seed
from avmsf.cli.options.splat import Options
from avmsf.cli.printing import next_command, print_result, say
from avmsf.cli.scenes import opened_scene, stage_line
from avmsf.gaussians.ply import read_splats
from avmsf.pipeline.config import SceneConfig


def run(options: Options) -> int:
    """Make the Gaussians; return 130 where Ctrl-C stopped it."""
    config = with_seed(SceneConfig(views=options.views, splat=options.config), options.config.seed or None)
    try:
        with opened_scene(options, config, command="avmsf splat") as scene:
            cloud = scene.cloud
            gaussians = len(read_splats(cloud.path))
            if options.output is not None:
                copy_whole(cloud.path, options.output)
    except KeyboardInterrupt:
        say("avmsf splat: interrupted; repeat the command to continue")
        return INTERRUPTED
    lines = [counted(gaussians, "Gaussian"), *(stage_line(name, kept) for name, kept in scene.made().items())]
    if options.output is not None:
        lines.append(f"wrote {options.output}")
    path = options.output or cloud.path
    print_result("\n".join(lines), {"cloud": str(path), "gaussians": gaussians}, json=options.json)
    next_command("avmsf info", path, "--plots plots")
    return 0
