"""The page and its studio together: struck, located, edited in two tabs; and the page without a network."""

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from PIL import Image

from avmsf.export.web import write_webpage
from avmsf.field.store import load
from avmsf.studio.guard import policy_of
from avmsf.studio.opening import open_target
from avmsf.studio.server import PAGE
from factories.made_fields import BANK
from plate_page import answer, plate_object, plate_table, words_on
from served import Served, open_plate, plate_field, wav

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page, Request

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


STEP = 4.0 ** (1 / 200)
"""Pitch of one step to the right."""
Edits = tuple["Page", Served]


@pytest.fixture
def edits(serving: Any, visit_studio: Any, tmp_path: Path) -> Edits:
    """Return the page's tab of edits, and its studio."""
    server = serving(open_plate(tmp_path / "home"))
    page = visit_studio(server)
    page.click("#tab-edit")
    return page, server


def requests_of(page: "Page") -> list[tuple[str, Any]]:
    """Return the list in which the page's requests that change the field are going to be."""
    asked: list[tuple[str, Any]] = []

    def note(request: "Request") -> None:
        what = request.url.rsplit("/", 1)[1].partition("?")[0]
        if request.method == "POST":
            asked.append((what, None if what == "lead" else request.post_data_json))

    page.on("request", note)
    return asked


def slider(page: "Page", name: str) -> "Locator":
    return page.locator("#sheet-edit .slider", has_text=name).first


def move(page: "Page", name: str) -> None:
    """Move a slider by one step to the right."""
    slider(page, name).locator("input").focus()
    page.keyboard.press("ArrowRight")


def shown(page: "Page", *names: str) -> list[str]:
    """Return what sliders say."""
    return [slider(page, name).locator("output").inner_text() for name in names]


def until_revision(page: "Page", number: int) -> None:
    page.wait_for_function(f"avmsf.studio.revision === {number}")


def pitch_of_page(page: "Page") -> float:
    """Return the first mode's pitch in what the page plays now, over that of the field as it was opened."""
    page.wait_for_function("avmsf.studio.engine.bundle === avmsf.studio.bundle")
    return float(page.evaluate("avmsf.studio.engine.tuned.frequency[0]")) / float(BANK.frequency[0])


def test_an_edit_is_heard_undone_and_saved(edits: Edits, tmp_path: Path) -> None:
    page, _ = edits
    asked = requests_of(page)
    move(page, "Pitch")
    until_revision(page, 2)
    page.wait_for_function("avmsf.studio.last !== undefined")
    assert pitch_of_page(page) == pytest.approx(STEP)
    page.click("#sheet-edit >> text=Undo")
    until_revision(page, 3)
    assert pitch_of_page(page) == pytest.approx(1.0)
    assert shown(page, "Pitch") == ["× 1.00"], "the sliders go back with the field"
    assert page.is_disabled("#sheet-edit >> text=Undo")
    move(page, "Pitch")
    page.fill("#sheet-edit input[type=text]", "higher")
    page.click("text=Save as")
    page.wait_for_selector("text=Saved:")
    saved = load(tmp_path / "home" / "higher.safetensors").bank
    torch.testing.assert_close(saved.frequency, BANK.frequency * STEP, rtol=1e-6, atol=0)
    page.click("text=Save as")
    page.wait_for_selector("text=higher.safetensors: expected a new name")
    assert [what for what, _ in asked] == ["edit", "undo", "edit", "save", "save"], "saved with the last move"


@pytest.mark.parametrize("act", ["slider", "save", "undo"])
def test_another_tabs_edit_is_shown_and_not_overwritten(edits: Edits, act: str, tmp_path: Path) -> None:
    page, server = edits
    move(page, "Decay time")
    until_revision(page, 2)
    assert server.ask("POST", "edit", {"base": 2, "size": 2.0, "pitch": 1.25}).status == 200
    if act == "slider":
        move(page, "Pitch")
    elif act == "save":
        page.fill("#sheet-edit input[type=text]", "mine")
        page.click("text=Save as")
    else:
        page.click("#sheet-edit >> text=Undo")
    page.wait_for_selector("text=Another tab has changed this field")
    assert server.manifest()["live"]["revision"] == 3
    assert not (tmp_path / "home" / "mine.safetensors").exists()
    assert shown(page, "Size", "Pitch", "Decay time") == ["× 2.00", "× 1.25", "× 1.00"]
    move(page, "Decay time")
    until_revision(page, 4)
    sliders = server.manifest()["live"]["sliders"]
    assert (sliders["size"], sliders["pitch"]) == (2.0, 1.25), "on top of the other tab's"


def test_undo_waits_for_the_edit_that_it_undoes(edits: Edits) -> None:
    page, _ = edits
    asked, held = requests_of(page), list[Any]()
    move(page, "Size")
    until_revision(page, 2)
    page.route("**/edit", lambda route: held.append(route))
    move(page, "Pitch")
    page.wait_for_timeout(400)
    page.click("#sheet-edit >> text=Undo")
    page.wait_for_timeout(100)
    held[0].continue_()
    until_revision(page, 4)
    assert [(what, words["base"]) for what, words in asked] == [("edit", 1), ("edit", 2), ("undo", 3)]
    assert shown(page, "Size", "Pitch") == ["× 1.01", "× 1.00"]
    assert words_on(page) == ""


def test_an_edit_that_is_refused_is_neither_saved_nor_kept(edits: Edits, tmp_path: Path) -> None:
    page, _ = edits
    refuse = {"error": "pitch: expected modes below half the sample rate"}
    page.route("**/edit", lambda route: answer(route, refuse, 422))
    move(page, "Pitch")
    page.wait_for_selector("text=expected modes below half the sample rate")
    page.fill("#sheet-edit input[type=text]", "mine")
    page.click("text=Save as")
    page.wait_for_timeout(200)
    assert not (tmp_path / "home" / "mine.safetensors").exists(), "what is not heard is not saved"
    page.click("text=Revert it")
    assert shown(page, "Pitch") == ["× 1.00"]
