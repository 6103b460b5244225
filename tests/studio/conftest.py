"""A browser, and folders on loopback for it to read."""

import contextlib
import functools
import http.server
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from avmsf.studio.opening import Opened
from plate_page import Open, lay_out, plate_object, plate_strikes, plate_table
from served import Served, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = Path(os.environ.get("AVMSF_CHROMIUM", "/usr/bin/chromium"))
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--autoplay-policy=user-gesture-required"),
]


@pytest.fixture(scope="session")
def browser() -> Iterator["Browser"]:
    """Return headless Chromium, or skip where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install 'avmsf[dev]'")
    if not CHROMIUM.is_file():
        pytest.skip(f"no browser at {CHROMIUM}: install Debian's chromium, or name one in AVMSF_CHROMIUM")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def serve() -> Iterator[Callable[[Path], str]]:
    """Return a function that serves a folder on loopback until the tests end, and returns its URL."""
    with contextlib.ExitStack() as servers:

        def start(folder: Path) -> str:
            handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
            server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
            thread.start()
            servers.callback(server.server_close)
            servers.callback(thread.join)
            servers.callback(server.shutdown)
            return f"http://127.0.0.1:{server.server_address[1]}/"

        yield start


@pytest.fixture(scope="session")
def site(serve: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., str]:
    """Return a function that gives the address of the plate's page; the same one twice for the same wishes."""

    @functools.cache
    def address(kind: str = "points", *, surface: bool = False, strikes: bool = False, live: bool = False) -> str:
        table, files = plate_table(), tmp_path_factory.mktemp("object")
        bundle = {
            "object": plate_object(kind, files),
            "surface": plate_object("surface", files) if surface else None,
            "strikes": plate_strikes(table) if strikes else None,
        }
        return serve(lay_out(files / "site", table, live=live, **bundle))

    return address


@contextlib.contextmanager
def opening(browser: "Browser") -> Iterator[Open]:
    """Yield a function that opens an address, after `before(page)`, in a browser of its own."""
    with contextlib.ExitStack() as opened:

        def open_page(address: str, before: Callable[["Page"], Any] = lambda page: None) -> "Page":
            # The driver waits by evaluating words in the page, which a studio's policy forbids; another test has that.
            context = browser.new_context(viewport={"width": 900, "height": 600}, bypass_csp=True)
            opened.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(15_000)
            before(page)
            page.goto(address)
            page.evaluate("window.avmsf.ready.then(() => null)")
            return page

        yield open_page


@pytest.fixture
def visit(browser: "Browser", site: Callable[..., str]) -> Iterator[Open]:
    """Return a function that opens the plate's page, after `before(page)`."""
    with opening(browser) as open_page:
        yield lambda before=lambda page: None, **wishes: open_page(site(**wishes), before)


@pytest.fixture(scope="module")
def page(browser: "Browser", site: Callable[..., str]) -> Iterator["Page"]:
    """Return one page of the plate's contacts without a server, for tests that leave no more behind than a blow."""
    with opening(browser) as open_page:
        yield open_page(site())


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[Callable[[Opened], Served]]:
    """Return a function that opens something in a studio of its own, which ends with the test."""
    with contextlib.ExitStack() as servers:
        yield lambda opened: servers.enter_context(served(opened, tmp_path / "scratch"))


@pytest.fixture
def visit_studio(browser: "Browser") -> Iterator[Open]:
    """Return a function that opens a studio's page, after `before(page)`."""
    with opening(browser) as open_page:
        yield lambda server, *before: open_page(f"http://127.0.0.1:{server.port}/{server.token}/", *before)
