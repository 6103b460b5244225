"""The page's modal bank in a browser: how far it is from Python's render, and how many blows it sounds at once."""

import base64
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avmsf.export.sampled_field import SampledField
from avmsf.export.web import make_bundle
from avmsf.modal.modes import ForcePulse
from avmsf.modal.residual_noise import shape_noise
from benchmarks.browser import chromium, served, write_site
from benchmarks.records import Record, Settings, records

RATE, SECONDS, MODES, CONTACTS = 44_100.0, 3.0, 128, 16
VOICES = (32, 64, 128)
QUICK_RATE, MAX_VOICES = 60, 64
"""Impacts a second of a quick row, and how many of them sound at once."""
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


def sound(settings: Settings) -> Iterator[Record]:
    """The page's modal bank, rendered in an OfflineAudioContext by headless Chromium, with dampings shared or not.

    error: largest difference from the field's own render, over the loudest sample. speed: seconds of sound a second of
    wall time, one core, of 128 modes an impact that all ring to the end (nothing is culled), excited within .1 s,
    with noise; best of three. voices: impacts at once that keep up with real time. quick: 60 impacts a second,
    each to ring for longer than it takes, so that all but the last 64 have to make room.
    """
    with chromium() as browser:
        for shared in (True, False):
            field, dampings = _ringing_field(shared=shared), "shared dampings" if shared else "dampings of each contact"
            with _loaded(browser, field) as page:
                for name, impacts, pulse in _cases():
                    found, expected = _rendered(page, impacts)[0], _expected(field, impacts, pulse)
                    error = float(np.abs(found - expected).max() / np.abs(expected).max())
                    yield from records({"error": error}, group=dampings, object=name)
                for count in settings.some(VOICES):
                    impacts = [{"row": number % CONTACTS, "when": 0.1 * number / count} for number in range(count)]
                    speed = max(SECONDS / _rendered(page, impacts, voices=count)[1] for _ in range(3))
                    # Work grows with the voices only where each has resonators of its own.
                    yield from records({"speed": speed, "voices": count * speed}, group=dampings, object=f"{count}")
                steady = range(round(QUICK_RATE * SECONDS))
                impacts = [{"row": number % CONTACTS, "when": number / QUICK_RATE} for number in steady]
                speed = SECONDS / _rendered(page, impacts, voices=MAX_VOICES)[1]
                yield from records({"speed": speed}, group=dampings, object="quick")


def _ringing_field(*, shared: bool) -> SampledField:
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
    spread = [{"row": each % CONTACTS, "force": 0.5 + each / 32, "when": 3001 * each / RATE} for each in range(32)]
    yield "32 that overlap", spread, None


def _expected(field: SampledField, impacts: list[dict[str, Any]], pulse: ForcePulse | None) -> np.ndarray:
    sound = np.zeros(round(SECONDS * RATE))
    for impact in impacts:
        one = field.render(torch.tensor([impact["row"]]), force=impact.get("force", 1.0), pulse=pulse)[0]
        begin = round(impact.get("when", 0.0) * RATE)
        sound[begin:] += one.double().numpy()[: len(sound) - begin]
    return sound


def _rendered(page: Any, impacts: list[dict[str, Any]], *, voices: int = 64) -> tuple[np.ndarray, float]:
    text, wall = page.evaluate(_RENDER, [impacts, SECONDS, voices])
    return np.frombuffer(base64.b64decode(text), dtype="<f4").astype(np.float64), float(wall)


@contextmanager
def _loaded(browser: Any, field: SampledField) -> Iterator[Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "page"
        write_site(make_bundle(field), folder)
        (folder / "page" / "start.js").write_text(_START)
        (folder / "index.html").write_text('<!doctype html><script type="module" src="page/start.js"></script>')
        with served(folder) as address:
            page = browser.new_page()
            page.goto(address)
            page.evaluate("window.loaded")
            yield page
            page.close()
