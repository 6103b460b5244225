"""A headless browser, pages in it, and folders and studios that are served to it."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from pathlib import Path
from typing import Any

from avmsf.export.web import Bundle, page_files
from avmsf.export.writing import write_folder

AVMSF = (sys.executable, "-c", "import sys; from avmsf.cli import main; sys.exit(main())")
WIDE = {"width": 1280, "height": 800}
_CHROMIUM = "/usr/bin/chromium"
_ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]


@contextmanager
def chromium() -> Iterator[Any]:
    """Run a headless browser."""
    # Only these measurements need one, and other benchmarks run without it.
    with import_module("playwright.sync_api").sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=_CHROMIUM, args=_ARGUMENTS)
        yield browser
        browser.close()


@contextmanager
def opened(browser: Any, address: str, viewport: dict[str, int] = WIDE, **context: Any) -> Iterator[Any]:
    """Open an address in a profile of its own, and wait until the page is ready."""
    # The studio's page forbids the evaluation of text, by which playwright waits.
    profile = browser.new_context(viewport=viewport, bypass_csp=True, **context)
    try:
        page = profile.new_page()
        page.goto(address)
        page.evaluate("window.avmsf.ready.then(() => null)")
        yield page
    finally:
        profile.close()


def write_site(bundle: Bundle, folder: Path) -> None:
    """Write a bundle and the page's files beside it."""
    write_folder(folder, bundle.files, bundle.manifest)
    for name, content in page_files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder and yield its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


@contextmanager
def studio(*words: str) -> "Iterator[tuple[subprocess.Popen[str], str, list[str]]]":
    """Run `avmsf studio` and yield its process, its address, and the lines that it prints, in the end all."""
    command = [*AVMSF, "studio", *words, "--port", "0", "--no-browser"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    lines = list[str]()
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                lines.append(line)
                found = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+/", "".join(lines).replace("\n", ""))
                if found is not None:
                    break
            else:
                raise RuntimeError(f"avmsf studio did not start: {''.join(lines)}")
            reader = threading.Thread(target=lines.extend, args=(process.stdout,), daemon=True)
            reader.start()
            yield process, found[0], lines
        finally:
            process.terminate()
            process.wait(60)
        reader.join()
