"""The page's modal bank in a browser: how far it is from Python's render, and how many blows it sounds at once."""

import base64
import math
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avmsf.export.bundle import make_bundle
from avmsf.export.sampled_field import SampledField
from avmsf.export.web import page_files
from avmsf.modal.modes import ForcePulse
from avmsf.modal.residual_noise import shape_noise
from benchmarks.report import Options, Report, Table, show

CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]
RATE, SECONDS, MODES, CONTACTS = 44_100.0, 3.0, 128, 16
VOICES, STRUCK_SECONDS = (32, 64, 128), 3.0
QUICK, MOST = 60, 64
CONVENTIONS = (
    "render_error: largest difference between the page's modal bank, rendered in an OfflineAudioContext by headless "
    "Chromium, and the field's own render of the same blows, over the loudest sample; the worst of the rows.",
    f"voices: {MODES} modes a blow at {RATE:g} Hz that all ring to the end (nothing is culled), struck within a tenth "
    "of a second, with noise. real time: seconds of sound a second of wall time, one core. page.voices: blows at once "
    "that keep up with real time where every contact has its own dampings, from the largest number that was run. A row "
    f"of quick blows: {QUICK} a second for all that time, each to ring for longer than it takes, so that all but the "
    f"last {MOST} have to make room.",
)
_START = """
import { loadBundle } from "./api.js";
import { renderOffline } from "./sound.js";
window.loaded = loadBundle().then((bundle) => { Object.assign(window, { bundle, renderOffline }); });
"""
_RENDER = """async ([blows, seconds, voices]) => {
  const begun = performance.now();
  const sound = await renderOffline(bundle, blows, seconds, { voices });
  const wall = (performance.now() - begun) / 1000;
  const bytes = new Uint8Array(sound.buffer, sound.byteOffset, sound.byteLength);
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  return [btoa(text), wall];
}"""


def measure(options: Options) -> Report:
    """Run both measurements, for shared dampings and for those of each contact."""
    rows: list[tuple[str | float, ...]] = []
    speeds: list[tuple[str | float, ...]] = []
    worst, voices, quick = 0.0, {True: 0.0, False: 0.0}, {True: 0.0, False: 0.0}
    with _browser() as browser:
        for shared in (True, False):
            table = ringing_table(shared=shared)
            with _opened(browser, table) as page:
                for name, blows, pulse in _cases():
                    found = _rendered(page, blows, SECONDS)[0]
                    expected = _expected(table, blows, pulse)
                    error = float(np.abs(found - expected).max() / np.abs(expected).max())
                    worst = max(worst, error)
                    rows.append((f"{name}, {_kind(shared)}", error))
                for count in VOICES[: 1 if options.quick_look else None]:
                    factor = _speed(page, count)
                    # Work grows with the voices only where each has resonators of its own.
                    voices[shared] = count * factor
                    speeds.append((f"{count} blows, {_kind(shared)}", factor, count * factor))
                quick[shared] = _quick_speed(page)
                speeds.append((f"{QUICK} blows a second, {_kind(shared)}", quick[shared], "-"))
    figures = {
        "page.render_error": worst,
        "page.voices": voices[False],
        "page.voices_shared": voices[True],
        "page.quick_blows_speed": quick[False],
        "page.quick_blows_speed_shared": quick[True],
    }
    tables = (
        Table("the page's sound against Python's", ("blows", "error"), rows),
        Table("the page's sound against real time", ("at once", "times real time", "blows in real time"), speeds),
    )
    return Report(CONVENTIONS, tables, figures)


def ringing_table(*, shared: bool) -> SampledField:
    """Return contacts with modes from 60 Hz to 18 kHz that ring for long, all of them, and faint noise."""
    generator = torch.Generator().manual_seed(0)
    frequency = torch.logspace(math.log10(60.0), math.log10(18_000.0), MODES, dtype=torch.float64)
    damping = torch.linspace(0.5, 1.5, MODES, dtype=torch.float64)
    drawn = torch.randn(4, CONTACTS, MODES, dtype=torch.float64, generator=generator)
    out = torch.nn.functional.normalize(drawn[3, :, :3], dim=1).float()
    noise = shape_noise(torch.full((65,), 1e-3), contacts=1, samples=round(SECONDS * RATE), generator=generator)[0]
    return SampledField(
        0.1 * out,
        out,
        frequency,
        damping if shared else damping * torch.exp(0.1 * drawn[2]),
        torch.complex(drawn[0], 0.3 * drawn[1]).to(torch.complex64) / MODES,
        noise,
        RATE,
        name="ringing",
    )


def _cases() -> Iterator[tuple[str, list[dict[str, Any]], ForcePulse | None]]:
    yield "one", [{"row": 0}], None
    yield "one at force 25", [{"row": 1, "force": 25.0}], None
    soft = {"contactTime": 2e-3, "shape": "half-sine"}
    yield "half sine of 2 ms", [{"row": 2, **soft}], ForcePulse(2e-3)
    yield "Hertz pulse of 1 ms", [{"row": 3, "contactTime": 1e-3, "shape": "hertz"}], ForcePulse(1e-3, "hertz")
    spread = [{"row": place % CONTACTS, "force": 0.5 + place / 32, "when": 3001 * place / RATE} for place in range(32)]
    yield "32 that overlap", spread, None


def _expected(table: SampledField, blows: list[dict[str, Any]], pulse: ForcePulse | None) -> np.ndarray:
    sound = np.zeros(round(SECONDS * RATE))
    for blow in blows:
        one = table.render(torch.tensor([blow["row"]]), force=blow.get("force", 1.0), pulse=pulse)[0].double().numpy()
        begin = round(blow.get("when", 0.0) * RATE)
        sound[begin:] += one[: len(sound) - begin]
    return sound


def _speed(page: Any, count: int) -> float:
    """Return how many seconds of `count` blows at once are rendered in a second, the best of three."""
    blows = [{"row": place % CONTACTS, "when": 0.1 * place / count} for place in range(count)]
    return max(STRUCK_SECONDS / _rendered(page, blows, STRUCK_SECONDS, voices=count)[1] for _ in range(3))


def _quick_speed(page: Any) -> float:
    """Return how many seconds of blows that steal one another's voices are rendered in a second."""
    blows = [{"row": place % CONTACTS, "when": place / QUICK} for place in range(round(QUICK * STRUCK_SECONDS))]
    return STRUCK_SECONDS / _rendered(page, blows, STRUCK_SECONDS, voices=MOST)[1]


def _rendered(page: Any, blows: list[dict[str, Any]], seconds: float, *, voices: int = 64) -> tuple[np.ndarray, float]:
    text, wall = page.evaluate(_RENDER, [blows, seconds, voices])
    return np.frombuffer(base64.b64decode(text), dtype="<f4").astype(np.float64), float(wall)


def _kind(shared: bool) -> str:
    return "shared dampings" if shared else "dampings of each contact"


@contextmanager
def _browser() -> Iterator[Any]:
    # Only this measurement needs a browser, and other benchmarks run without one.
    with import_module("playwright.sync_api").sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of each request."""


@contextmanager
def _opened(browser: Any, table: SampledField) -> Iterator[Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "page"
        make_bundle(table).write(folder)
        for path, content in page_files().items():
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_bytes(content)
        (folder / "page" / "start.js").write_text(_START)
        (folder / "index.html").write_text('<!doctype html><script type="module" src="page/start.js"></script>')
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
        page.evaluate("window.loaded")
        yield page
        page.close()
        server.shutdown()
        thread.join()
        server.server_close()


if __name__ == "__main__":
    show(measure(Options(("sound",), quick_look="--quick" in sys.argv)), Options(("sound",)), name="studio sound")
