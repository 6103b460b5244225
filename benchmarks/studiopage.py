"""The studio's page: how soon it can be struck, how soon a click sounds, and what it looks like."""

import io
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from importlib.resources import as_file, files
from pathlib import Path
from statistics import median
from typing import Any

import soundfile
import torch

from avmsf._utils.arrays import fibonacci_sphere
from avmsf.export.bundle import make_bundle
from avmsf.export.sampled_field import SampledField
from avmsf.gaussians.initialize import StartPoints, starting_cloud
from avmsf.gaussians.ply import write_splats
from avmsf.simulate.simulation_folder import example_mesh, write_textured
from benchmarks.browser import AVMSF, WIDE, chromium, opened, served, studio, write_site
from benchmarks.records import REPOSITORY, Record, Settings, records

GAUSSIANS, MODES, RATE = 20_000, 128, 44_100.0
LOADS, CLICKS = 5, 20
PICTURES = REPOSITORY / "docs" / "pictures" / "studio"
NARROW, TALL = {"width": 390, "height": 780}, {"width": 1280, "height": 1000}
RINGING_MILLISECONDS = 300
MAX_PICTURE_BYTES = 200_000
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


def page(settings: Settings) -> Iterator[Record]:
    """Load the page with 20,000 Gaussians, as many contacts and 128 modes, and click it; medians, and worst.

    interactive_seconds: from the navigation's start until the object is drawn and can be struck, three and spark from
    this machine's disk, headless Chromium without a graphics processor, fresh browser profiles. click_to_sample_ms:
    from the pointer's release to the message that carries the impact to the sound's thread, and from there to its first
    sample, by the sound's own clock, the 1.5 ms by which the limiter looks ahead counted: our own code, without the
    browser's way through its mixer and the loudspeaker; different contacts.
    """
    with tempfile.TemporaryDirectory() as scratch:
        field = _ball()
        start = StartPoints(field.points.float(), (field.normals + 1) / 2, field.normals)
        ball, site = Path(scratch) / "ball.ply", Path(scratch) / "site"
        write_splats(starting_cloud(start, degree=0, scale=1.0, opacity=0.95, flatness=0.2), ball)
        write_site(make_bundle(field, object=ball), site)
        with served(site) as address, chromium() as browser:
            loads = []
            for _ in settings.some(range(LOADS)):
                with opened(browser, address) as loaded:
                    loads.append(float(loaded.evaluate("window.avmsf.readyAt")) / 1000)
            with opened(browser, address) as loaded:
                posted, begun = _clicks(loaded)
    for name, values in (("interactive_seconds", loads), ("message_ms", posted), ("sample_ms", begun)):
        words = "click_to_" * name.endswith("ms") + name
        yield from records({words: median(values), f"{words}_worst": max(values)})


def _ball() -> SampledField:
    """Return a ball whose modes are waves over it: as large as a page's field gets, with nothing to be learned."""
    normals = fibonacci_sphere(GAUSSIANS).float()
    draw = torch.Generator().manual_seed(0)
    waves = torch.randn(3, MODES, generator=draw) * torch.linspace(2, 12, MODES)
    sine = torch.sin(normals @ waves) * torch.linspace(1, 0.1, MODES)
    frequency = torch.logspace(math.log10(300), math.log10(16_000), MODES, dtype=torch.float64)
    gains, noise = torch.complex(sine, 0.1 * sine.roll(1, dims=1)), 1e-3 * torch.randn(round(RATE), generator=draw)
    return SampledField(0.1 * normals, normals, frequency, 2 + frequency / 200, gains, noise, RATE, name="Ball")


def _clicks(loaded: Any) -> tuple[list[float], list[float]]:
    """Return milliseconds from each click to the message, and to the bank's first sample."""
    loaded.evaluate(_LISTEN)
    middle = loaded.evaluate("window.avmsf.project([0, 0, 0])")
    for click in range(CLICKS + 1):
        angle = 2.4 * click
        loaded.mouse.click(middle["x"] + 90 * math.cos(angle), middle["y"] + 90 * math.sin(angle))
        loaded.wait_for_function(f"window.clicks.length === {click + 1} && window.clicks[{click}].begun !== undefined")
    # The first click starts the browser's sound.
    clicks = loaded.evaluate("window.clicks")[1:]
    posted = [each["posted"] - each["released"] for each in clicks]
    heard = [1000 * (each["begun"] - each["heard"]) for each in clicks]
    return posted, [max(pair) for pair in zip(heard, posted, strict=True)]


def screenshots(settings: Settings) -> Iterator[Record]:
    """Write the documentation's pictures anew, of the real studio with the example capture's field."""
    folder = Path(tempfile.mkdtemp()) if settings.quick else PICTURES
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,
        as_file(files("avmsf") / "example") as example,
        chromium() as browser,
    ):
        capture, field, empty = (Path(scratch) / name for name in ("example", "example.safetensors", "new object"))
        shutil.copytree(example, capture)
        write_textured(example_mesh(), capture)
        words = ("fit", str(capture), "--gain-model", "smooth", "--output", str(field))
        subprocess.run([*AVMSF, *words], check=True, capture_output=True)
        with studio(str(field), "--capture", str(capture)) as (_, address, _):
            _draw_field(browser, address, capture, folder)
        empty.mkdir()
        shutil.copy(capture / "surface.ply", empty)
        with studio(str(empty)) as (_, address, _):
            _draw_capture(browser, address, capture, folder)
    for path in sorted(folder.glob("*.png")):
        size = path.stat().st_size
        if size > MAX_PICTURE_BYTES:
            raise RuntimeError(f"{path}: {size} bytes, expected at most {MAX_PICTURE_BYTES}")
        yield from records({"bytes": size}, object=path.name)


def _draw_field(browser: Any, address: str, capture: Path, folder: Path) -> None:
    # The edit comes last: what it makes of the field is seen by every page opened after it.
    for name, viewport, context in (
        ("dark", WIDE, {"color_scheme": "dark"}),
        ("narrow", NARROW, {}),
        ("strike", WIDE, {}),
    ):
        with opened(browser, address, viewport, **context) as loaded:
            place = loaded.evaluate("window.avmsf.project(window.avmsf.studio.view.controls.target.toArray())")
            loaded.mouse.click(place["x"] + 30, place["y"] + 20)
            # The first impact starts the browser's sound.
            loaded.wait_for_function("window.avmsf.studio.engine.context.state === 'running'")
            loaded.wait_for_timeout(1000)
            _shoot(loaded, folder / f"{name}.png", ringing=True)
            if name == "strike":
                loaded.click("#tab-modes")
                loaded.click("tbody tr >> nth=2")
                _shoot(loaded, folder / "modes.png", ringing=True)
                loaded.click("#tab-find")
                loaded.set_input_files("#sheet-find input[type=file]", str(capture / "003.wav"))
                loaded.wait_for_selector("#sheet-find dl", timeout=120_000)
                _shoot(loaded, folder / "find.png", ringing=True)
                loaded.click("#unpaint")
                loaded.click("#tab-edit")
                loaded.select_option("#sheet-edit select >> nth=1", "wood")
                loaded.wait_for_function("window.avmsf.studio.revision > 1", timeout=60_000)
                _shoot(loaded, folder / "edit.png", ringing=True)


def _draw_capture(browser: Any, address: str, recorded: Path, folder: Path) -> None:
    with opened(browser, address, TALL) as loaded:
        for number, (right, down) in enumerate(((-40, 30), (50, -20), (0, 60)), start=1):
            place = loaded.evaluate("window.avmsf.project(window.avmsf.studio.view.controls.target.toArray())")
            loaded.mouse.click(place["x"] + right, place["y"] + down)
            # As loud as a recording should be: the example's are all far from full scale.
            samples, rate = soundfile.read(recorded / f"{number:03d}.wav")
            memory = io.BytesIO()
            soundfile.write(memory, samples * 0.5 / abs(samples).max(), rate, "FLOAT", format="WAV")
            upload = {"name": f"{number:03d}.wav", "mimeType": "audio/wav", "buffer": memory.getvalue()}
            loaded.set_input_files("#sheet-capture input[type=file]", upload)
            loaded.wait_for_selector("#sheet-capture dl")
            if number < 3:
                loaded.click("text=Save recording")
                loaded.wait_for_function(f"document.querySelectorAll('#sheet-capture .listing li').length === {number}")
        _shoot(loaded, folder / "capture.png")


def _shoot(loaded: Any, path: Path, *, ringing: bool = False) -> None:
    """Write a picture; `ringing`, of the moment in which the object is struck again."""
    loaded.mouse.move(5, 300)
    loaded.wait_for_timeout(400)
    if ringing:
        loaded.evaluate("window.avmsf.strike(window.avmsf.studio.row)")
        loaded.wait_for_timeout(RINGING_MILLISECONDS)
    loaded.screenshot(path=str(path))
