"""The page and its studio together, the page without a network, and what the page may run."""

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from PIL import Image

from avmsf.export.web import write_webpage
from avmsf.studio.guard import policy_of
from avmsf.studio.opening import open_target
from avmsf.studio.routes import PAGE
from opened_plate import open_plate, plate_field, wav
from plate_page import plate_object, plate_table, words_on

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.page
WATCH = "window.refused = []; addEventListener('securitypolicyviolation', (e) => refused.push(e.violatedDirective));"


def test_a_field_is_struck_and_a_dropped_recording_of_it_located(serving, visit_studio, tmp_path):
    server = serving(open_plate(tmp_path / "home", "elastic"))
    page = visit_studio(server)
    row = page.evaluate("avmsf.strike(60, { force: 2 })")
    place = torch.tensor(page.evaluate(f"avmsf.studio.contacts.position({row})"))
    sound = torch.tensor(page.evaluate(f"avmsf.renderOffline([{{ row: {row} }}]).then((sound) => [...sound])"))
    expected = plate_field("elastic").render(place[None])[0]
    assert (sound - expected).abs().max() < 1e-4 * expected.abs().max()
    recording = wav(expected.numpy())
    page.evaluate(
        """(text) => {
             const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
             const dataTransfer = new DataTransfer();
             dataTransfer.items.add(new File([bytes], "impact.wav", { type: "audio/wav" }));
             window.dispatchEvent(new DragEvent("drop", { dataTransfer, cancelable: true }));
           }""",
        base64.b64encode(recording).decode(),
    )
    page.wait_for_selector("#sheet-find dl")
    [found] = server.ask("POST", "locate", recording).words["impacts"]
    probability = np.frombuffer(base64.b64decode(found["probability"]), "<f4")
    expected_paint = 1 + np.log10(np.maximum(probability / probability.max(), 1e-4)) / 4
    np.testing.assert_allclose(page.evaluate("[...avmsf.painted().values]"), expected_paint, atol=1e-5)
    assert f"{1000 * found['credible_region']['radius']:.1f} mm radius" in page.inner_text("#sheet-find")


def test_the_page_needs_no_more_than_it_is_allowed(serving: Any, browser: "Browser", tmp_path: Path) -> None:
    policy = policy_of((PAGE / "index.html").read_text())
    assert "https:" not in next(part for part in policy.split("; ") if part.startswith("script-src"))
    assert "unsafe-inline" not in policy
    assert "'unsafe-eval'" not in policy
    opened = open_plate(tmp_path / "home")
    server = serving(open_target(opened.field, object=plate_object("gaussians", tmp_path)))
    context = browser.new_context()
    page = context.new_page()
    page.set_default_timeout(30_000)
    page.add_init_script(WATCH)
    page.goto(f"http://127.0.0.1:{server.port}/{server.token}/")
    page.evaluate("window.avmsf.ready.then(() => null)")
    assert page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => Math.max(...sound))") > 0
    assert page.evaluate("refused") == []
    page.evaluate(
        "() => { const script = document.createElement('script'); script.textContent = 'window.evil = 1';"
        "document.body.append(script); return new Promise((done) => setTimeout(done, 50)) }"
    )
    assert page.evaluate("[window.evil ?? null, refused]") == [None, ["script-src-elem"]]
    context.close()


@pytest.mark.parametrize(("kind", "name"), [("gaussians", "page.html"), ("mesh", "folder")])
def test_an_exported_page_shows_and_plays_the_object_without_a_network(browser, kind, name, tmp_path, serve):
    write_webpage(plate_table(), tmp_path / name, object=plate_object(kind, tmp_path))
    address = serve(tmp_path / name) if name == "folder" else (tmp_path / name).as_uri()
    context = browser.new_context()
    context.set_offline(name != "folder")
    page = context.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.add_init_script(WATCH)
    page.goto(address)
    page.evaluate("window.avmsf.ready.then(() => null)")
    assert words_on(page) == ""
    page.wait_for_timeout(500)
    with Image.open(io.BytesIO(page.locator("#stage").screenshot())) as picture:
        assert len(picture.convert("RGB").getcolors(maxcolors=1 << 24)) > 20
    sound = torch.tensor(page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => [...sound])"))
    expected = plate_table().render(torch.tensor([5]))[0]
    torch.testing.assert_close(sound, expected, rtol=0, atol=1e-6 * float(expected.abs().max()), check_dtype=False)
    assert page.evaluate("refused") == []
    assert [each for each in asked if not each.startswith((address, "data:", "blob:"))] == []
    context.close()
