"""`avmsf surface`: a folder's mesh, photographs or video in, the object's surface out."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, get_args

import trimesh
import tyro

from avmsf.bench.pictures import expect_format, save_picture
from avmsf.bench.surfacepictures import draw_surface
from avmsf.capture.surface import Surface, SurfaceKind, find_surface, read_surface, write_surface
from avmsf.capture.together import expect_one_unit
from avmsf.cli import INTERRUPTED
from avmsf.cli.printing import print_text, say
from avmsf.cli.scenebar import SceneBar
from avmsf.cli.scenes import SceneOptions, stage_line
from avmsf.cli.writing import OutputError, expect_writable
from avmsf.files import write_whole
from avmsf.pipeline.config import SceneConfig, ViewsConfig
from avmsf.pipeline.reconstruct import keep_surface, object_shape
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.stages import StageFolder
from avmsf.scene.splatconfig import SplatConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Write an object's surface alone: its mesh, or without one what its views show.

    In meters and in the frame of the folder. Views show both sides of a wall where both were seen, and cavities as deep
    as they were seen. `avmsf reconstruct` tries this as one of the bodies that may vibrate; the others have walls of
    several thicknesses below its outer side, since views do not show how thick a wall is. Views and Gaussians are made
    first where the cache does not have them.
    """

    output: Annotated[Path | None, tyro.conf.arg(metavar="SURFACE.ply")] = None
    """File to write the surface to; surface.ply in the cache holds it anyway."""
    format: SurfaceKind | None = None
    """Format of that file; what its name ends in without it."""
    picture: Path | None = None
    """Where to draw the surface, and two cuts through it: a file that ends in .png, .pdf or .svg."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    splat: SplatConfig = field(default_factory=SplatConfig)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf surface", args=words, config=(tyro.conf.FlagCreatePairsOff,))


def run(options: Options) -> int:
    """Make and write the surface; return 130 where Ctrl-C stopped it."""
    if options.output is not None:
        expect_writable(options.output)
    if options.picture is not None:
        expect_format(options.picture)
    kind = options.format or ("ply" if options.output is None else kind_of(options.output))
    settings = options.read_settings()
    expect_one_unit(options.folder, settings)
    stages = StageFolder(options.kept)
    try:
        with SceneBar() as bar:
            scene = SceneStages(
                options.folder,
                stages,
                SceneConfig(views=options.views, splat=options.splat),
                settings=settings,
                listener=bar.listener,
            )
            scene.expect_any()
            with stages.lock("avmsf surface"):
                kept = keep_surface(stages, *object_shape(find_surface(options.folder, settings), scene))
                surface = read_surface(kept.path)
                if options.output is not None:
                    write_whole(
                        options.output, lambda place: write_surface(surface, place, kind=kind), raising=OutputError
                    )
    except KeyboardInterrupt:
        say("avmsf surface: interrupted; the same command goes on from where it was")
        return INTERRUPTED
    print_text(surface_words(surface))
    for name, made in {**scene.made(), "surface": kept}.items():
        print_text(stage_line(name, made))
    if options.picture is not None:
        save_picture(draw_surface(surface, title=f"{options.folder.resolve().name}: surface"), options.picture)
    for path in (options.output, options.picture):
        if path is not None:
            print_text(f"wrote {path}")
    return 0


def kind_of(path: Path) -> SurfaceKind:
    """Return the format that a file's name ends in. Raises OutputError for another."""
    kinds: tuple[SurfaceKind, ...] = get_args(SurfaceKind)
    for kind in kinds:
        if path.suffix.lower() == f".{kind}":
            return kind
    raise OutputError(
        f"{path}: expected a name that ends in {', '.join(f'.{kind}' for kind in kinds)}, got "
        f"{path.suffix or 'no ending'}: rename it, or give --format"
    )


def surface_words(surface: Surface) -> str:
    """Say how large a surface is, and whether it is closed."""
    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=True)
    extent = " x ".join(f"{1000 * side:.3g}" for side in mesh.extents)
    words = f"{len(surface.faces)} triangles, {extent} mm, area {1e4 * mesh.area:.3g} cm2"
    closed = f"closed, volume {1e6 * mesh.volume:.3g} cm3" if mesh.is_watertight else "not closed"
    return f"{words}, {closed}"
