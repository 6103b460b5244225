"""`avmsf surface`: a folder's mesh, photographs or video in, the object's surface out."""

from pathlib import Path

import torch
import trimesh
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.wording import counted
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import TABLE, in_folder, read_rows, understand
from avmsf.capture.together import find_surface
from avmsf.cli import INTERRUPTED
from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.scenes import with_seed
from avmsf.cli.options.surface import Options
from avmsf.cli.printing import next_command, print_result, say
from avmsf.cli.scenes import opened_scene, stage_line
from avmsf.mesh.surface import Surface, read_surface, write_surface
from avmsf.pipeline.config import SceneConfig
from avmsf.pipeline.reconstruct import keep_surface, object_shape
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.surfaces import draw_surface


def run(options: Options) -> int:
    """Make and write the surface; return 130 where Ctrl-C stopped it."""
    config = with_seed(SceneConfig(views=options.views, splat=options.splat), options.seed)
    try:
        with opened_scene(options, config, command="avmsf surface") as scene:
            given = find_surface(options.folder, scene.settings)
            kept = keep_surface(scene.stages, *object_shape(given, scene))
            surface = read_surface(kept.path)
            if options.output is not None:
                write_whole(
                    options.output, lambda place: write_surface(surface, place, kind=options.kind), raising=OutputError
                )
    except KeyboardInterrupt:
        say("avmsf surface: interrupted; repeat the command to continue")
        return INTERRUPTED
    lines = [surface_words(surface)]
    lines += [stage_line(name, made) for name, made in {**scene.made(), "surface": kept}.items()]
    picture = None if options.plots is None else options.plots / "surface.png"
    if picture is not None:
        title = f"{options.folder.resolve().name}: surface"
        contacts = _contacts(options.folder, scene.settings)
        save_picture(draw_surface(surface, title=title, contacts=contacts), picture)
    lines += [f"wrote {path}" for path in (options.output, picture) if path is not None]
    values = {"surface": str(options.output or kept.path), "triangles": len(surface.faces)}
    print_result("\n".join(lines), values, json=options.json)
    next_command("avmsf reconstruct", options.folder, "-o field.safetensors")
    return 0


def _contacts(folder: Path, settings: CaptureSettings) -> Float64[Tensor, "contacts 3"] | None:
    """Return the contacts of the folder's table, meters; None without a table. Raises CaptureError for a bad one."""
    if not (folder / TABLE).is_file():
        return None
    with in_folder(folder):
        contacts = [understand(row, settings).contact for row in read_rows(folder)[0]]
    return torch.tensor(contacts, dtype=torch.float64)


def surface_words(surface: Surface) -> str:
    """Return a message on a surface's size, and on whether it is closed."""
    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=True)
    extent = " x ".join(f"{1000 * side:.3g}" for side in mesh.extents)
    words = f"{counted(len(surface.faces), 'triangle')}, {extent} mm, area {1e4 * mesh.area:.3g} cm2"
    closed = f"closed, volume {1e6 * mesh.volume:.3g} cm3" if mesh.is_watertight else "not closed"
    return f"{words}, {closed}"
