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

from plate_page import Open, Serve, plate_site, visiting

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


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")
        super().end_headers()


@pytest.fixture(scope="session")
def serve() -> Iterator[Callable[[Path], str]]:
    """Return a function that serves a folder on loopback until the tests end, and returns its URL."""
    with contextlib.ExitStack() as servers:

        def start(folder: Path) -> str:
            handler = functools.partial(_Quiet, directory=str(folder))
            server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
            thread.start()
            servers.callback(server.server_close)
            servers.callback(thread.join)
            servers.callback(server.shutdown)
            return f"http://127.0.0.1:{server.server_address[1]}/"

        yield start


@pytest.fixture(scope="session")
def site(serve: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory) -> Serve:
    """Return a function that gives the address of the plate's page."""
    return plate_site(serve, tmp_path_factory)


@pytest.fixture
def visit(browser: "Browser", site: Serve) -> Iterator[Open]:
    """Return a function that opens the plate's page in a browser of its own."""
    with visiting(browser, site) as open_page:
        yield open_page


@pytest.fixture(scope="module")
def plain(browser: "Browser", site: Serve) -> Iterator["Page"]:
    """Return one page of the plate's contacts without a server, for tests that leave no more behind than a blow."""
    with visiting(browser, site) as open_page:
        yield open_page()
