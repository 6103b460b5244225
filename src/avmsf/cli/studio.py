"""`avmsf studio`: the web page that plays an object, locates impacts, edits fields and records captures."""

import os
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options import Common, Flag, Int
from avmsf.cli.output import print_json, say
from avmsf.cli.paths import Existing, FileKind, ShapeFile, arg
from avmsf.errors import StudioError, from_extra
from avmsf.pipeline.config import Preset

_SHOWN = "a field, a capture folder, a folder of images or a mesh"
_KINDS: tuple[FileKind, ...] = ("a sound field", "a folder", "a mesh or Gaussians")


@dataclass(frozen=True)
class Options(Common):
    """Open a web page that plays an object, locates impacts, edits fields and records captures.

    The page plays and edits a field and locates recordings with it; of a capture folder, a folder of images or a mesh
    it records impacts and reconstructs a field. The page is served only to this computer, at an address that holds a
    secret; Ctrl-C ends it.
    """

    target: tyro.conf.Positional[Annotated[Path | None, arg("FIELD|FOLDER|MESH"), Existing(_SHOWN, _KINDS)]] = None
    """A field file, a capture folder, a folder that shows the object, or a mesh. A mesh is copied to a folder of its
    name next to it, which becomes the capture; but surface.obj, .ply, .glb or .stl, and Gaussians called splats.ply or
    point_cloud.ply, open the folder that holds them as the capture. --capture names another folder for either."""
    object: ShapeFile = None
    """Mesh, in meters, or Gaussians to show; by default the capture's."""
    capture: Annotated[Path | None, arg("CAPTURE")] = None
    """Capture folder of a field, or for a mesh the folder to make."""
    port: Int = None
    """Port to serve at; 0 for any free one. By default 8634, for which a browser remembers that the page may record, or
    any free one if that is taken."""
    no_browser: Flag = False
    """Do not open the browser."""
    preset: Preset = "default"
    """Settings of a reconstruction; paper: as published, takes hours."""

    def _check(self) -> None:
        if self.target is None:
            raise StudioError.expected(_SHOWN, name="target")


def run(options: Options) -> int:
    """Serve the page until Ctrl-C."""
    with from_extra("studio", "starlette and uvicorn", raising=StudioError):
        import_module("starlette")
        import_module("uvicorn")
    from avmsf.studio.opening import open_target
    from avmsf.studio.server import serve

    assert options.target is not None
    opened = open_target(options.target, object=options.object, capture=options.capture)
    serve(opened, port=options.port, browser=not options.no_browser, log=_print, preset=options.preset)
    say("closed")
    sys.stdout.flush()
    # The interpreter would wait for a thread that still computes, or break off in its midst with a dump of its memory.
    os._exit(0)


def _print(address: str) -> None:
    say(f"open {address}   (Ctrl-C ends)")
    print_json({"address": address})
    # A program that starts the studio reads this while the page is served.
    sys.stdout.flush()
