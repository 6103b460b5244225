"""`avmsf studio`: the web page that plays an object, locates impacts, edits fields and records captures."""

import os
import sys

from avmsf.cli.options.studio import Options
from avmsf.cli.printing import print_json, say
from avmsf.errors import StudioError


def run(options: Options) -> int:
    """Serve the page until Ctrl-C."""
    try:
        from avmsf.studio.opening import open_target
        from avmsf.studio.server import serve
        from avmsf.studio.studio import StudioConfig
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in ("anyio", "starlette", "uvicorn"):
            raise
        raise StudioError(
            f"expected starlette and uvicorn for the page's server, got no {error.name}; pip install 'avmsf[studio]'",
            name=error.name,
        ) from error
    assert options.target is not None
    opened = open_target(options.target, object=options.object, capture=options.capture)
    computing = serve(
        opened,
        port=options.port,
        browser=not options.no_browser,
        log=lambda address: _print(address, json=options.json),
        config=StudioConfig(options.model, options.modes, preset=options.preset),
    )
    say("closed")
    if computing:
        # The interpreter would wait for the thread, or break off in the midst of it with a dump of its memory.
        os._exit(0)
    return 0


def _print(address: str, *, json: bool) -> None:
    say(f"open {address}   (Ctrl-C ends)")
    if json:
        print_json({"address": address})
        # A program that starts the studio reads this while the page is served.
        sys.stdout.flush()
