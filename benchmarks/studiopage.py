"""The studio's page: how soon it can be struck, how soon a click sounds, and what it looks like."""

import io
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from importlib.resources import as_file, files
from pathlib import Path
from statistics import median
from typing import Any

import soundfile
import torch

from avmsf._utils.arrays import fibonacci_sphere
from avmsf.export.bundle import make_bundle
from avmsf.export.sampled_field import SampledField
from avmsf.export.web import page_files
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats
from avmsf.simulate.simulation_folder import example_mesh, write_textured
from benchmarks.report import Report, Table
from benchmarks.studiosound import ARGUMENTS, CHROMIUM

GAUSSIANS, MODES, RATE = 20_000, 128, 44_100.0
LOADS, CLICKS = 5, 20
CONVENTIONS = (
    f"interactive_seconds: from the navigation's start until the object is drawn and can be struck, {GAUSSIANS} "
    f"Gaussians, as many contacts and {MODES} modes, three and spark from this machine's disk, headless Chromium "
    "without a graphics processor; median of fresh browser profiles.",
    "click_to_sample_ms: from the pointer's release to the message that carries the blow to the sound's thread, and "
    "from there to its first sample, by the sound's own clock, the 1.5 ms by which the limiter looks ahead counted: "
    "our own code, without the browser's way through its mixer and the loudspeaker. Median of clicks on different "
    "contacts.",
)
WIDE, NARROW = {"width": 1280, "height": 800}, {"width": 390, "height": 780}
TALL = {"width": 1280, "height": 1000}
RINGING_MILLISECONDS = 300
LARGEST_PICTURE = 200_000
"""Bytes."""
_COMMAND = (sys.executable, "-c", "import sys; from avmsf.cli import main; sys.exit(main())")
_LISTEN = """() => {
  const { engine } = window.avmsf.studio;
  const post = engine.node.port.postMessage.bind(engine.node.port);
  window.clicks = [];
  const released = () => window.clicks.push({ released: performance.now(), heard: engine.context.currentTime });
  window.addEventListener("pointerup", released, true);
  engine.node.port.postMessage = (message) => {
    post(message);
    if (message.type === "strike") window.clicks.at(-1).posted = performance.now();
  };
  engine.onbegin = ({ time }) => { window.clicks.at(-1).begun = time; };
}"""


def measure_page() -> Report:
    """Load the page with a large field, and click it."""
    with tempfile.TemporaryDirectory() as scratch:
        site = _site(Path(scratch))
        with _served(site) as address, _chromium() as browser:
            loads = [_seconds_to_ready(browser, address) for _ in range(LOADS)]
            posted, begun = _clicks(browser, address)
    figures = {
        "page.interactive_seconds": median(loads),
        "page.click_to_sample_ms": median(begun),
        "page.click_to_message_ms": median(posted),
    }
    table = Table("the page", ("", "median", "worst"), (
        ("until it can be struck, s", median(loads), max(loads)),
        ("click to message, ms", median(posted), max(posted)),
        ("click to the first sample, ms", median(begun), max(begun)),
    ))  # fmt: skip
    return Report(CONVENTIONS, (table,), figures)


def ball_table(count: int = GAUSSIANS, modes: int = MODES) -> SampledField:
    """Return a ball whose modes are waves over it: as large as a page's field gets, with nothing to be learned."""
    normals = fibonacci_sphere(count).float()
    draw = torch.Generator().manual_seed(0)
    waves = torch.randn(3, modes, generator=draw) * torch.linspace(2, 12, modes)
    sine = torch.sin(normals @ waves) * torch.linspace(1, 0.1, modes)
    frequency = torch.logspace(math.log10(300), math.log10(16_000), modes, dtype=torch.float64)
    noise = 1e-3 * torch.randn(round(RATE), generator=draw)
    return SampledField(
        0.1 * normals,
        normals,
        frequency,
        2 + frequency / 200,
        torch.complex(sine, 0.1 * sine.roll(1, dims=1)),
        noise,
        RATE,
        name="Ball",
    )


def draw_screenshots(folder: Path) -> tuple[Path, ...]:
    """Make the example capture's field, open it in the real studio, and write pictures of the page into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,
        as_file(files("avmsf") / "example") as example,
        _chromium() as browser,
    ):
        capture = Path(scratch) / "example"
        shutil.copytree(example, capture)
        write_textured(example_mesh(), capture)
        field = Path(scratch) / "example.safetensors"
        _avmsf("fit", str(capture), "--gain-model", "smooth", "--output", str(field))
        with _studio(str(field), "--capture", str(capture)) as address:
            written = _draw_field(browser, address, capture, folder)
        empty = Path(scratch) / "new object"
        empty.mkdir()
        shutil.copy(capture / "surface.ply", empty)
        with _studio(str(empty)) as address:
            written.append(_draw_capture(browser, address, capture, folder))
    for path in written:
        if path.stat().st_size > LARGEST_PICTURE:
            raise RuntimeError(f"{path}: {path.stat().st_size} bytes, expected at most {LARGEST_PICTURE}")
    return tuple(written)


def _draw_field(browser: Any, address: str, capture: Path, folder: Path) -> list[Path]:
    written = []
    # The edit comes last: what it makes of the field is seen by every page opened after it.
    with _page(browser, address, WIDE, color_scheme="dark") as page:
        _strike(page)
        written.append(_shoot(page, folder / "dark.png", ringing=True))
    with _page(browser, address, NARROW) as page:
        _strike(page)
        written.append(_shoot(page, folder / "narrow.png", ringing=True))
    with _page(browser, address, WIDE) as page:
        _strike(page)
        written.append(_shoot(page, folder / "strike.png", ringing=True))
        page.click("#tab-modes")
        page.click("tbody tr >> nth=2")
        written.append(_shoot(page, folder / "modes.png", ringing=True))
        page.click("#tab-find")
        page.set_input_files("#sheet-find input[type=file]", str(capture / "003.wav"))
        page.wait_for_selector("#sheet-find dl", timeout=120_000)
        written.append(_shoot(page, folder / "find.png", ringing=True))
        page.click("#unpaint")
        page.click("#tab-edit")
        page.select_option("#sheet-edit select >> nth=1", "wood")
        page.wait_for_function("window.avmsf.studio.revision > 1", timeout=60_000)
        written.append(_shoot(page, folder / "edit.png", ringing=True))
    return written


def _draw_capture(browser: Any, address: str, recorded: Path, folder: Path) -> Path:
    with _page(browser, address, TALL) as page:
        for number, (right, down) in enumerate(((-40, 30), (50, -20), (0, 60)), start=1):
            place = page.evaluate("window.avmsf.project(window.avmsf.studio.view.eye.controls.target.toArray())")
            page.mouse.click(place["x"] + right, place["y"] + down)
            page.set_input_files("#sheet-capture input[type=file]", _well_recorded(recorded / f"{number:03d}.wav"))
            page.wait_for_selector("#sheet-capture dl")
            if number < 3:
                page.click("text=Save recording")
                page.wait_for_function(f"document.querySelectorAll('#sheet-capture .listing li').length === {number}")
        return _shoot(page, folder / "capture.png")


def _well_recorded(path: Path) -> Any:
    """Return a recording as loud as one should be, to be uploaded: the example's are all far from full scale."""
    samples, rate = soundfile.read(path)
    memory = io.BytesIO()
    soundfile.write(memory, samples * 0.5 / abs(samples).max(), rate, "FLOAT", format="WAV")
    return {"name": path.name, "mimeType": "audio/wav", "buffer": memory.getvalue()}


def _strike(page: Any) -> None:
    place = page.evaluate("window.avmsf.project(window.avmsf.studio.view.eye.controls.target.toArray())")
    page.mouse.click(place["x"] + 30, place["y"] + 20)
    # The first blow starts the browser's sound.
    page.wait_for_function("window.avmsf.studio.engine.context.state === 'running'")
    page.wait_for_timeout(1000)


def _shoot(page: Any, path: Path, *, ringing: bool = False) -> Path:
    """Write a picture; `ringing`, of the moment in which the blow is struck again."""
    page.mouse.move(5, 300)
    page.wait_for_timeout(400)
    if ringing:
        page.evaluate("window.avmsf.strike(window.avmsf.studio.row)")
        page.wait_for_timeout(RINGING_MILLISECONDS)
    page.screenshot(path=str(path))
    return path


def _site(scratch: Path) -> Path:
    """Write the page with the ball as Gaussians and the libraries beside it."""
    table = ball_table()
    start = StartPoints(table.points.float(), (table.normals + 1) / 2, table.normals)
    write_splats(starting_cloud(start, degree=0, scale=1.0, opacity=0.95, flatness=0.2), scratch / "ball.ply")
    site = scratch / "site"
    make_bundle(table, object=scratch / "ball.ply").write(site)
    for name, content in page_files().items():
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (site / name).write_bytes(content)
    return site


def _seconds_to_ready(browser: Any, address: str) -> float:
    with _page(browser, address, WIDE) as page:
        return float(page.evaluate("window.avmsf.readyAt")) / 1000


def _clicks(browser: Any, address: str) -> tuple[list[float], list[float]]:
    """Return milliseconds from each click to the message, and to the bank's first sample."""
    with _page(browser, address, WIDE) as page:
        page.evaluate(_LISTEN)
        middle = page.evaluate("window.avmsf.project([0, 0, 0])")
        for click in range(CLICKS + 1):
            angle = 2.4 * click
            page.mouse.click(middle["x"] + 90 * math.cos(angle), middle["y"] + 90 * math.sin(angle))
            page.wait_for_function(
                f"window.clicks.length === {click + 1} && window.clicks[{click}].begun !== undefined"
            )
        # The first click starts the browser's sound.
        clicks = page.evaluate("window.clicks")[1:]
    posted = [each["posted"] - each["released"] for each in clicks]
    return posted, [
        max(1000 * (each["begun"] - each["heard"]), least) for each, least in zip(clicks, posted, strict=True)
    ]


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""


@contextmanager
def _served(folder: Path) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


@contextmanager
def _chromium() -> Iterator[Any]:
    # Only this measurement needs a browser, and other benchmarks run without one.
    with import_module("playwright.sync_api").sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@contextmanager
def _page(browser: Any, address: str, viewport: dict[str, int], **context: Any) -> Iterator[Any]:
    """Open an address in a profile of its own, and wait until it is ready."""
    # The studio's page forbids the evaluation of text, by which playwright waits.
    profile = browser.new_context(viewport=viewport, bypass_csp=True, **context)
    try:
        page = profile.new_page()
        page.goto(address)
        page.evaluate("window.avmsf.ready.then(() => null)")
        yield page
    finally:
        profile.close()


@contextmanager
def _studio(*words: str) -> Iterator[str]:
    """Run `avmsf studio` and yield its address."""
    command = [*_COMMAND, "studio", *words, "--port", "0", "--no-browser"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        try:
            yield _address(process)
        finally:
            process.terminate()


def _address(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    said: list[str] = []
    for line in process.stdout:
        said.append(line)
        found = re.search(r"http://127\.0\.0\.1:\d+/[\w-]+/", "".join(said).replace("\n", ""))
        if found is not None:
            return found[0]
    raise RuntimeError(f"avmsf studio did not start: {''.join(said)}")


def _avmsf(*words: str) -> None:
    subprocess.run([*_COMMAND, *words], check=True, capture_output=True)
