"""Draw the pictures of docs/studio.md: `avmsf demo demo`, then `python docs/pictures/studio.py demo`.

They show the studio's page on the demo's field. It needs Chromium, at /usr/bin or where AVMSF_CHROMIUM says, and
playwright, of the extra `dev`.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import Browser, Page, sync_playwright

import avmsf

PICTURES = Path(__file__).parent / "studio"
VIEWPORT = {"width": 1160, "height": 1090}
"""The longest tab fits."""
SECONDS = 120.0
"""How long anything may take, without a GPU."""
MODE = 1
LOCATED = 0
"""Row of the located recording in the demo's held-out ones."""
CAPTURED = ("005.wav", "010.wav", "011.wav")
"""Recordings of the picture of a capture; the last is not saved yet."""


def main() -> None:
    """Draw all pictures of the demo in the folder that the command line names."""
    demo = Path(sys.argv[1])
    with TemporaryDirectory(prefix="avmsf-") as name, sync_playwright() as driver:
        chromium = driver.chromium.launch(
            executable_path=os.environ.get("AVMSF_CHROMIUM", "/usr/bin/chromium"), args=["--no-sandbox"]
        )
        # The studio names what it shows after the capture's folder, and writes to it.
        mug, cup = Path(name) / "mug", Path(name) / "cup.ply"
        shutil.copytree(demo / "capture", mug)
        (mug / ".avmsf").mkdir()
        shutil.copy(demo / "mug-surface.ply", mug / ".avmsf/surface.ply")
        shutil.copy(demo / "mug-surface.ply", cup)
        with opened_page(chromium, demo / "mug.safetensors", "--capture", mug, "--object", demo / "mug.ply") as page:
            draw_field(page, mug, avmsf.load(demo / "mug.safetensors"))
        with opened_page(chromium, cup) as page:
            draw_capture(page, mug)


@contextmanager
def opened_page(browser: Browser, *arguments: object) -> Iterator[Page]:
    """Yield the page of `avmsf studio` with these arguments."""
    command = [sys.executable, "-c", "from avmsf.cli import main; main()", "studio", *map(str, arguments)]
    studio = subprocess.Popen([*command, "--no-browser", "--port", "0"], stderr=subprocess.PIPE, text=True)
    assert studio.stderr is not None
    try:
        address = next(found[1] for line in studio.stderr if (found := re.match(r"open (\S+)", line)))
        # Waiting for an expression evaluates text, which the page's policy forbids.
        page = browser.new_page(viewport=VIEWPORT, bypass_csp=True)
        page.set_default_timeout(1000 * SECONDS)
        page.goto(address)
        page.evaluate("window.avmsf.ready.then(() => null)")
        yield page
        page.close()
    finally:
        studio.terminate()
        studio.communicate()


def draw_field(page: Page, capture: Path, field: avmsf.SoundField) -> None:
    """Draw all tabs of a field but the one that records."""
    page.mouse.click(310, 530)
    save(page, "strike", seconds=0.3)
    page.click("text=Show surface")
    page.click("#tab-modes")
    page.click(f"#sheet-modes tr[data-mode='{MODE}']")
    save(page, "modes")
    page.click("#tab-find")
    held_out = [name for name in avmsf.read(capture).impacts.names if name not in field.origin.trained_on]
    page.set_input_files("#sheet-find input[type=file]", capture / held_out[LOCATED])
    page.wait_for_selector("#sheet-find dl")
    save(page, "locate")
    page.click("text=Clear the colors")
    page.click("text=Show Gaussians")
    page.click("text=Reset view")
    page.click("#tab-edit")
    page.locator("#sheet-edit select").nth(1).select_option("wood")
    page.wait_for_function("avmsf.studio.live.revision > 1")
    save(page, "edit")


def draw_capture(page: Page, recordings: Path) -> None:
    """Draw the tab that records, with impacts of another capture."""
    impacts = avmsf.read(recordings).impacts
    for number, name in enumerate(CAPTURED, start=1):
        contact = impacts.contacts[impacts.names.index(name)].tolist()
        where = page.evaluate("(contact) => avmsf.project(contact)", contact)
        page.mouse.click(where["x"], where["y"])
        page.set_input_files("#sheet-capture input[type=file]", recordings / name)
        page.wait_for_selector("#sheet-capture dl")
        if number < len(CAPTURED):
            page.click("text=Save recording")
            page.wait_for_selector(f"#sheet-capture h2:has-text('{number} impact')")
    save(page, "capture")


def save(page: Page, name: str, *, seconds: float = 1.5) -> None:
    """Write what the page shows after `seconds`, by when it is drawn, without a focus ring."""
    page.evaluate("document.activeElement.blur()")
    page.wait_for_timeout(1000 * seconds)
    page.screenshot(path=PICTURES / f"{name}.png")


main()
