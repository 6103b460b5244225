"""The page's modal bank, in a browser: what it renders is what Python renders."""

import base64
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from avmsf.export.sampled_field import SampledField
from avmsf.export.web import make_bundle, write_webpage
from avmsf.modal.modes import ForcePulse, synthesize
from factories.made_tables import STRUCK_RATE as RATE
from factories.made_tables import struck_table

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

BLANK = '<!doctype html><meta charset="utf-8"><script type="importmap">{"imports": {}}</script><title>sound</title>'
START = '<script type="module" src="page/start.js"></script>'
"""Loads what the tests call, as the studio's own page does."""
MODULE = """
import { loadBundle } from "./api.js";
import { resample } from "./audio.js";
import { pulseSamples, renderOffline, SoundEngine, swingAfter } from "./sound.js";
import { Bank, Limiter } from "./bank.js";
Object.assign(window, { loadBundle, renderOffline, SoundEngine, pulseSamples, resample, swingAfter, Bank, Limiter });
window.asText = (samples) => {
  // Numbers one by one take playwright seconds.
  const bytes = new Uint8Array(Float32Array.from(samples).buffer);
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  return btoa(text);
};
window.loaded = loadBundle().then((bundle) => { window.bundle = bundle; });
"""


KINDS = ("shared", "perContact")


@pytest.fixture(scope="module")
def tables() -> dict[str, SampledField]:
    return {kind: struck_table(shared=kind == "shared") for kind in KINDS}


@pytest.fixture(scope="module")
def pages(
    tables: dict[str, SampledField], browser: "Browser", serve: Callable[[Path], str], tmp_path_factory: Any
) -> Iterator[dict[str, "Page"]]:
    opened = {kind: browser.new_page() for kind in KINDS}
    for kind, page in opened.items():
        folder = tmp_path_factory.mktemp(kind)
        write_webpage(tables[kind], folder)
        (folder / "page" / "start.js").write_text(MODULE)
        (folder / "index.html").write_text(BLANK + START)
        page.goto(serve(folder))
        page.evaluate("window.loaded")
    yield opened
    for page in opened.values():
        page.close()


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def table(kind: str, tables: dict[str, SampledField]) -> SampledField:
    return tables[kind]


@pytest.fixture
def page(kind: str, pages: dict[str, "Page"]) -> "Page":
    return pages[kind]


@pytest.fixture
def any_page(pages: dict[str, "Page"]) -> "Page":
    """Return one page, for what no damping has a part in."""
    return pages["shared"]


def heard(page: "Page", impacts: Sequence[dict[str, Any]], **options: Any) -> np.ndarray:
    sound = page.evaluate(
        """async ([impacts, seconds, options]) => {
             const sound = await renderOffline(bundle, impacts, seconds ?? undefined, options);
             return window.asText(sound);
           }""",
        [list(impacts), options.pop("seconds", None), options],
    )
    return numbers(sound)


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=np.float32).astype(np.float64)


def error(found: np.ndarray, expected: torch.Tensor) -> float:
    """Return the largest difference over the loudest sample."""
    assert found.shape == tuple(expected.shape)
    return float(np.abs(found - expected.numpy()).max() / expected.abs().max())


@pytest.mark.parametrize(
    ("impact", "pulse"),
    [
        ({"row": 0}, None),
        ({"row": 3, "force": 40.0}, None),
        ({"row": 1, "force": 1e-4, "contactTime": 2.3e-3}, ForcePulse(2.3e-3)),
        ({"row": 2, "force": 2.0, "contactTime": 1e-3, "shape": "hertz"}, ForcePulse(1e-3, "hertz")),
        ({"row": 2, "force": 2.0, "contactTime": 9e-3, "shape": "hertz"}, ForcePulse(9e-3, "hertz")),
    ],
)
def test_a_impact_is_what_python_renders(page: "Page", table: SampledField, impact: dict[str, Any], pulse: Any) -> None:
    expected = table.render(torch.tensor([impact["row"]]), force=impact.get("force", 1.0), pulse=pulse)[0]
    assert error(heard(page, [impact]), expected) < 1e-6


def test_a_rate_that_browsers_do_not_read_is_resampled(any_page: "Page") -> None:
    found = any_page.evaluate("async () => Array.from(await resample(Float32Array.of(0, 1, 0, -1), 400, 800))")
    assert found == [0, 0.5, 1, 0.5, 0, -0.5, -1, -1]


def test_a_harder_impact_has_the_same_background(any_page: "Page", tables: dict[str, SampledField]) -> None:
    """Of forces relative to the average impact's, which is of 9 N, and in the unit of its sound over its force."""
    steady = replace(tables["shared"], background_force=9.0)
    assert make_bundle(steady).manifest["backgroundForce"] == 9.0
    any_page.evaluate("bundle.manifest.backgroundForce = 9")
    for force in (0.01, 1.0, 2.0):
        expected = steady.render(torch.tensor([3]), force=9.0 * force)[0] / 9.0
        assert error(heard(any_page, [{"row": 3, "force": force}]), expected) < 1e-6
    any_page.evaluate("delete bundle.manifest.backgroundForce")


def test_impacts_overlap_from_the_very_sample_on_at_which_they_begin(page: "Page", table: SampledField) -> None:
    """At the beginning, the end and the middle of blocks of 128 samples, two in one block, two at once."""
    places = [
        (0, 1.0, 0),
        (1, -0.5, 127),
        (2, 3.0, 128),
        (3, 1.0, 5003),
        (4, 0.7, 5010),
        (5, 1.0, 9000),
        (0, 1.0, 9000),
    ]
    impacts = [{"row": row, "force": force, "when": frame / RATE} for row, force, frame in places]
    expected = torch.zeros(table.samples, dtype=torch.float64)
    for row, force, frame in places:
        one = table.render(torch.tensor([row]), force=force, samples=table.samples)[0].double()
        expected[frame:] += one[: table.samples - frame]
    assert error(heard(page, impacts), expected) < 1e-6


@pytest.mark.parametrize("rate", [11_025.0, 44_100.0])
def test_modes_are_the_same_at_any_sample_rate(page: "Page", table: SampledField, rate: float) -> None:
    samples = round(rate)
    found = page.evaluate(
        """async (rate) => {
             const tensors = { ...bundle.tensors, noise: new Float32Array(bundle.tensors.noise.length) };
             return asText(await renderOffline({ ...bundle, tensors }, [{ row: 4 }], 1, { sampleRate: rate }));
           }""",
        rate,
    )
    kept = table.frequency < rate / 2
    damping = table.take(torch.tensor([4])).damping[..., kept]
    expected = synthesize(table.gains[4:5, kept], table.frequency[kept], damping, samples=samples, sample_rate=rate)[0]
    assert error(numbers(found), expected) < 1e-6


def test_the_engine_plays_what_is_rendered_and_goes_on_with_another_field(page: "Page", table: SampledField) -> None:
    """Live messages, on a context that waits for them: a strike, a replacement, silence after its fade."""
    found, level = page.evaluate(
        """async (rate) => {
             const context = new OfflineAudioContext(1, rate, rate);
             const engine = await SoundEngine.start(bundle, { context });
             const at = (time, act) => context.suspend(time).then(() => {
               act();
               setTimeout(() => context.resume(), 100);
             });
             at(128 * 25 / rate, () => engine.node.port.postMessage(
               { type: "strike", impact: engine.tuned.impact(2, { force: 0.8 }) }));
             at(128 * 75 / rate, () => engine.replace(bundle));
             const sound = (await context.startRendering()).getChannelData(0);
             return [asText(sound), engine.level];
           }""",
        RATE,
    )
    ahead = round(0.0015 * RATE)
    sound = np.append(numbers(found)[ahead:], np.zeros(ahead))
    begin, end = 128 * 25, 128 * 75
    expected = level * table.render(torch.tensor([2]), force=0.8)[0]
    assert not sound[:begin].any()
    assert error(sound[begin:end], expected[: end - begin]) < 1e-6
    # The replaced field fades within 10 ms, along a cosine.
    whole = round(0.01 * RATE)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(whole) / whole)
    fading = expected[end - begin : end - begin + whole] * torch.from_numpy(fade)
    assert error(sound[end : end + whole], fading) < 1e-5
    assert not sound[end + whole :].any()


def test_the_loudest_contact_is_brought_to_half_of_full_scale(page: "Page", table: SampledField) -> None:
    level = page.evaluate("SoundEngine.start(bundle).then((engine) => { engine.close(); return engine.level; })")
    loudest = float(table.render(torch.arange(6))[:, : round(0.03 * RATE)].abs().max())
    assert level * loudest == pytest.approx(0.5, rel=0.05)


def test_a_click_is_heard_live(any_page: "Page") -> None:
    any_page.evaluate("""SoundEngine.start(bundle).then((engine) => {
      window.engine = engine;
      window.begun = new Promise((resolve) => { engine.onbegin = resolve; });
      addEventListener("pointerdown", () => engine.strike(0, { force: 2 }), { once: true });
    })""")
    any_page.mouse.click(5, 5)
    any_page.evaluate("begun")
    any_page.wait_for_function(
        """() => {
             const samples = new Float32Array(engine.analyser.fftSize);
             engine.analyser.getFloatTimeDomainData(samples);
             return samples.some((value) => Math.abs(value) > 0.1);
           }"""
    )
    any_page.evaluate("engine.close()")


BANK = """({ field, impacts, seconds, voices }) => {
  const rate = 16000, frequency = Float64Array.from(field.frequency), noise = Float32Array.from(field.noise);
  const bank = new Bank({ ...field, frequency, noise }, rate, 128, voices);
  const usual = { force: [1], strength: 1, noise: 1, loudest: 1, damping: null };
  for (const impact of impacts) bank.strike({ ...usual, ...impact });
  const sound = new Float64Array(128 * Math.ceil(seconds * rate / 128));
  for (let frame = 0; frame < sound.length; frame += 128) bank.render(sound.subarray(frame, frame + 128), frame);
  const banks = bank.shared === null ? bank.sounding.map((voice) => voice.resonators) : [bank.shared];
  const modes = banks.reduce((sum, { count }) => sum + count, 0);
  return { sound: Array.from(sound), voices: bank.sounding.length, modes };
}"""


def test_impacts_that_make_room_fade(page: "Page", kind: str) -> None:
    """Six sines of amplitude one where two may sound: a cut would be a step of up to 1, the sines' own are .04."""
    damping = [0.5]
    impact = {"sine": [1.0], "cosine": [0.0], "damping": None if kind == "shared" else damping}
    field = {"frequency": [100.0], "damping": damping if kind == "shared" else None, "noise": [1.0] * 20_000}
    field["noise"] = [0.0] if kind == "perContact" else field["noise"]
    given = {"field": field, "voices": 2, "seconds": 0.5}
    impacts = [{**impact, "frame": 1000 * number + 37} for number in range(6)]
    found = page.evaluate(BANK, {**given, "impacts": impacts})
    sound = np.asarray(found["sound"])
    steps = np.abs(np.diff(sound))
    # Each impact's own noise, all ones, sets in with it.
    steps[[impact["frame"] - 1 for impact in impacts]] = 0
    assert steps.max() < 6 * 2 * np.pi * 100 / RATE + 0.011
    assert found["voices"] == 2
    if kind == "perContact":
        assert np.abs(sound[-1600:]).max() < 2.0


def test_noise_does_not_break_off(page: "Page", kind: str) -> None:
    """A draw of ones, which would end in a step of one."""
    damping = None if kind == "perContact" else [400.0]
    field = {"frequency": [100.0], "damping": damping, "noise": [1.0] * 3000}
    impact = {"frame": 0, "sine": [1e-3], "cosine": [0.0], "loudest": 1e-3, "damping": [400.0]}
    found = page.evaluate(BANK, {"field": field, "voices": 8, "seconds": 0.5, "impacts": [impact]})
    sound = np.asarray(found["sound"])
    assert np.abs(np.diff(sound)).max() < 0.003
    np.testing.assert_allclose(sound[1000:3000], 1.0, rtol=0, atol=1e-4)
    assert not sound[3900:].any()
    assert found["voices"] == 0


LIMIT = """({ ahead, pieces }) => {
  const limiter = new Limiter(16000, ahead);
  return pieces.map((piece) => {
    const samples = Float64Array.from(piece, (value) => ({ nan: NaN, infinite: -Infinity })[value] ?? value);
    for (let from = 0; from < samples.length; from += 128) {
      const block = samples.subarray(from, from + 128);
      limiter.hold(block, block.length);
    }
    const said = limiter.limited;
    limiter.limited = false;
    return { sound: Array.from(samples), limited: said };
  });
}"""


def limited(page: "Page", *pieces: Any, ahead: int = 24) -> list[tuple[np.ndarray, bool]]:
    """Return what a limiter makes of pieces of sound, one after another, and whether it was at work in each."""
    found = page.evaluate(LIMIT, {"ahead": ahead, "pieces": [[*piece] for piece in pieces]})
    return [(np.asarray(each["sound"]), each["limited"]) for each in found]


@pytest.mark.parametrize("ahead", [0, 24])
def test_the_limiter_leaves_alone_what_fits_and_holds_the_rest(any_page: "Page", ahead: int) -> None:
    """Late by what it looks ahead; nothing else is changed, down to the last bit, before and after it was at work."""
    time = np.arange(2 * 16_000)
    quiet, loud = 0.96 * np.sin(time / 7), 30 * np.sin(time[:4000] / 7)
    (first, worked), (held, at_work), (last, _) = limited(
        any_page, quiet[:4000].tolist(), loud.tolist(), quiet.tolist(), ahead=ahead
    )
    np.testing.assert_array_equal(first[ahead:], quiet[: 4000 - ahead])
    assert not first[:ahead].any()
    assert not worked
    assert at_work
    assert np.abs(held).max() < 0.98 + 1e-12
    assert np.abs(held[-200:]).max() > 0.9
    np.testing.assert_array_equal(last[-8000:], quiet[-8000 - ahead : len(quiet) - ahead])


@pytest.mark.parametrize("bad", ["nan", "infinite", 1e12])
def test_a_faulty_sample_is_left_out_and_what_follows_sounds(any_page: "Page", bad: Any) -> None:
    tone = 0.5 * np.sin(np.arange(1280) / 5)
    faulty = tone.tolist()
    faulty[700] = bad
    ((sound, worked),) = limited(any_page, faulty)
    tone[700] = 0
    np.testing.assert_array_equal(sound[24:], tone[:-24])
    assert not worked


def test_volume_and_recordings_are_heard(any_page: "Page") -> None:
    """A recording of ones leaves at the level of the impacts, and at half of it once the volume is halved."""
    levels = any_page.evaluate(
        """async (rate) => {
             const context = new OfflineAudioContext(1, rate, rate);
             const engine = await SoundEngine.start(bundle, { context });
             const buffer = new AudioBuffer({ length: rate, sampleRate: rate });
             const height = 0.5 / engine.level;
             buffer.getChannelData(0).fill(height);
             engine.play(buffer);
             context.suspend(128 * 50 / rate).then(() => {
               engine.setVolume(0.5);
               setTimeout(() => context.resume(), 100);
             });
             const sound = (await context.startRendering()).getChannelData(0);
             return [sound[1000], sound[6000], sound[8000], sound[15000]];
           }""",
        RATE,
    )
    assert levels == pytest.approx([0.5, 0.5, 0.25, 0.25], rel=1e-5)


@pytest.mark.parametrize("damping", [0.0, 30.0, 2500.0])
@pytest.mark.parametrize(("frequency", "contact_time"), [(300.0, 0.0), (300.0, 0.002), (2600.0, 0.0005), (900.0, 0.02)])
def test_a_mallet_leaves_a_mode_swinging_as_the_page_draws_it(any_page, frequency, contact_time, damping):
    rate = 44_100.0
    words = "([f, d, r, t]) => swingAfter(pulseSamples(t, r, 'half-sine'), 2 * Math.PI * f / r, d / r)"
    found = any_page.evaluate(words, [frequency, damping, rate, contact_time])
    pulse = ForcePulse(contact_time, "half-sine").samples(rate).numpy()
    pole = np.exp((-damping + 2j * np.pi * frequency) / rate)
    expected = abs(sum(part * pole ** (len(pulse) - 1 - n) for n, part in enumerate(pulse)))
    assert found == pytest.approx(expected, rel=1e-9)
    assert found <= 1 + 1e-12


@pytest.mark.parametrize(("tone", "rate"), [(1000, 11_000), (500, 3000)])
def test_resampling_keeps_a_tone(any_page: "Page", tone: int, rate: int) -> None:
    found = any_page.evaluate(
        """async ([tone, rate]) => {
             const wave = Float32Array.from({ length: 4000 }, (_, n) => Math.sin(2 * Math.PI * tone * n / 8000));
             return Array.from(await resample(wave, 8000, rate));
           }""",
        [tone, rate],
    )
    assert len(found) == pytest.approx(4000 * rate / 8000, abs=1)
    middle = np.arange(200, len(found) - 200)
    expected = np.sin(2 * np.pi * tone * middle / rate)
    np.testing.assert_allclose(np.asarray(found)[middle], expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": 2}, "expected a field of format 1, got 2"),
        (
            {"tensors": {"sine": {"file": "field.bin", "offset": 0, "dtype": "float32", "shape": [10**7]}}},
            "expected 40000000 bytes",
        ),
        ({"tensors": {"sine": {"file": "none.bin", "offset": 0, "dtype": "float32", "shape": [1]}}}, "cannot be read"),
        ({"tensors": {"sine": {"file": "field.bin", "offset": 0, "dtype": "int8", "shape": [1]}}}, "type int8"),
        (
            {"tensors": {"sine": {"file": "odd.bin", "offset": 0, "dtype": "float32", "shape": [3]}}},
            "odd.bin: sine: expected numbers, got NaN at index 2",
        ),
    ],
)
def test_a_damaged_bundle_is_told(any_page: "Page", change: dict[str, Any], words: str) -> None:
    any_page.route("**/manifest.json", lambda route: route.fulfill(json={"format": 1, **change}))
    odd = np.array([0, 1, np.nan], dtype="<f4").tobytes()
    any_page.route("**/odd.bin", lambda route: route.fulfill(body=odd))
    said = any_page.evaluate("loadBundle().then(() => 'none', (error) => error.message)")
    any_page.unroute("**/manifest.json")
    any_page.unroute("**/odd.bin")
    assert words in said
