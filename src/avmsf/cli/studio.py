"""`avmsf studio`: the page where an object is struck and heard, and captures are made."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.printing import say
from avmsf.cli.writing import OutputError
from avmsf.errors import StudioError


@dataclass(frozen=True)
class Options:
    """Open a page where the object is struck and heard, blows are located, and captures are made.

    A field is struck, searched and edited; a capture folder, a folder of images or a mesh is struck, recorded and
    reconstructed. The page is served to this machine alone, at an address that holds a secret; Ctrl-C ends it.
    """

    target: tyro.conf.Positional[Annotated[Path | None, tyro.conf.arg(metavar="FIELD|FOLDER|MESH")]] = None
    """A field file, a capture folder, a folder that shows the object, or a mesh. Of a mesh, a folder of its name beside
    it becomes the capture and gets a copy; but surface.obj, .ply, .glb or .stl, and Gaussians called splats.ply or
    point_cloud.ply, open the folder that they lie in as the capture. --capture names another one for either."""
    object: Annotated[Path | None, tyro.conf.arg(metavar="MESH|PLY")] = None
    """Mesh, in metres, or Gaussians to show; what the capture folder has where it is not given."""
    capture: Path | None = None
    """Capture folder of a field, whose strikes are shown and added to; for a mesh, the folder to make."""
    port: int | None = None
    """Port to serve at; 0 for any free one. Without it 8634, where a browser remembers that the page may record, or any
    free one where that is taken."""
    browser: bool = True
    """Whether to open the browser."""
    model: str | None = None
    """Folder that holds a Stable Audio pipeline, or its name on the hub, to edit by words; needs the extra `text`."""
    modes: int = 128
    """Most modes that a reconstruction keeps."""
    fetch_modules: bool = False
    """First bring the page's libraries here by npm, so that it works without a network from then on."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf studio", args=words)


def run(options: Options) -> int:
    """Serve the page until Ctrl-C."""
    if options.modes < 1:
        raise OutputError(f"--modes is {options.modes}; expected 1 or more")
    try:
        from avmsf.studio.modules import fetch_modules, find_modules
        from avmsf.studio.opening import open_target
        from avmsf.studio.server import serve
        from avmsf.studio.studio import StudioConfig
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in ("anyio", "starlette", "uvicorn"):
            raise
        raise StudioError(
            f"the page's server needs starlette and uvicorn, and {error.name} is missing: pip install 'avmsf[studio]'"
        ) from error
    if options.fetch_modules:
        say(f"the page's libraries are in {fetch_modules()}")
        if options.target is None:
            return 0
    if options.target is None:
        raise StudioError("expected a field, a capture folder, a folder of images or a mesh to open, found none")
    opened = open_target(options.target, object=options.object, capture=options.capture)
    if find_modules() is None:
        say("the page takes three and spark from cdn.jsdelivr.net; --fetch-modules brings them here once and for all")
    computing = serve(
        opened,
        port=options.port,
        browser=options.browser,
        tell=lambda address: say(f"open {address}   (Ctrl-C ends)"),
        config=StudioConfig(options.model, options.modes),
    )
    say("closed")
    if computing:
        # The interpreter would wait for the thread, or break off in the midst of it with a dump of its memory.
        os._exit(0)
    return 0
