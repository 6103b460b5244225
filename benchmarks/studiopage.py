"""The studio's page: how soon it can be struck and how soon a click sounds."""

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import torch

from avmsf._utils.arrays import fibonacci_sphere
from avmsf.export.sampled_field import SampledField
from avmsf.export.web import make_bundle
from avmsf.gaussians.ply import write_splats
from avmsf.gaussians.start_points import StartPoints, starting_cloud
from benchmarks.browser import chromium, opened, served, write_site
from benchmarks.records import Record, Settings, records

GAUSSIANS, MODES, RATE = 20_000, 128, 44_100.0
LOADS, CLICKS = 5, 20
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

    interactive_seconds: from the navigation's start until the object is drawn and can be excited, three and spark from
    this machine's disk, headless Chromium without a graphics processor, fresh browser profiles. click_to_sample_ms:
    from the pointer's release to the message that carries the impact to the sound's thread, and from there to its first
    sample, by the sound's own clock, the 1.5 ms that the limiter delays it counted: our own code, without the
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
