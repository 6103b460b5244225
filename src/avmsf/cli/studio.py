"""`avmsf studio`: the page where an object is struck and heard, and captures are made."""

import os

from avmsf.cli.options.studio import Options
from avmsf.cli.printing import say
from avmsf.cli.writing import OutputError
from avmsf.errors import StudioError


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
        browser=not options.no_browser,
        tell=lambda address: say(f"open {address}   (Ctrl-C ends)"),
        config=StudioConfig(options.model, options.modes),
    )
    say("closed")
    if computing:
        # The interpreter would wait for the thread, or break off in the midst of it with a dump of its memory.
        os._exit(0)
    return 0
