"""The page and the studio's own server together: a field edited and saved, a capture made, by clicks alone."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch
from PIL import Image

from avmsf.capture import read_capture
from avmsf.field.store import load
from avmsf.studio.opening import Opened, open_target
from opened_plate import RATE, open_plate, plate_field, wav
from plate_page import SIDES, plate_object
from served import Served, served

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "home"


@contextmanager
def opened_page(browser: "Browser", opened: Opened, scratch: Path, *, wait_for_jobs: bool = False) -> Iterator["Page"]:
    with served(opened, scratch) as server:
        while wait_for_jobs and server.get("manifest.json").words["live"]["job"] is not None:
            time.sleep(0.1)
        # The driver waits by evaluating words in the page, which its policy forbids; test_policy.py has that.
        context = browser.new_context(viewport={"width": 900, "height": 600}, bypass_csp=True)
        page = context.new_page()
        page.set_default_timeout(15_000)
        page.goto(address(server))
        page.evaluate("window.avmsf.ready.then(() => null)")
        yield page
        context.close()


@pytest.mark.slow
def test_pictures_that_show_nothing_are_said_to_and_can_be_tried_again(
    browser: "Browser", home: Path, tmp_path: Path
) -> None:
    (home / "images").mkdir(parents=True)
    for number in range(3):
        Image.fromarray(np.full((24, 32, 3), 128, dtype=np.uint8)).save(home / "images" / f"{number}.png")
    with opened_page(browser, open_target(home), tmp_path / "scratch", wait_for_jobs=True) as page:
        said = page.locator("#words .bad", has_text="the reconstruction from the images failed")
        assert "images" in said.inner_text()
        said.locator("text=Try again").click()
        page.wait_for_selector("#words .word:has-text('being reconstructed')")
        assert page.evaluate("avmsf.studio.live.job") is not None


def address(server: Served) -> str:
    return f"http://127.0.0.1:{server.port}/{server.token}/"


def file_of(content: bytes) -> Any:
    return {"name": "blow.wav", "mimeType": "audio/wav", "buffer": content}


def test_a_field_is_struck_found_edited_and_saved(browser: "Browser", home: Path, tmp_path: Path) -> None:
    with opened_page(browser, open_plate(home), tmp_path / "scratch") as page:
        field = plate_field()
        row = page.evaluate("avmsf.strike(60, { force: 2 })")
        place = torch.tensor(page.evaluate(f"avmsf.studio.contacts.position({row})"))
        sound = torch.tensor(page.evaluate(f"avmsf.renderOffline([{{ row: {row} }}]).then((sound) => [...sound])"))
        expected = field.render(place[None])[0]
        assert (sound - expected).abs().max() < 1e-4 * expected.abs().max()
        page.click("#tab-find")
        page.set_input_files("#sheet-find input[type=file]", file_of(wav(expected.numpy())))
        page.wait_for_selector("#sheet-find dl")
        found = torch.tensor(page.evaluate("[...avmsf.painted().values]"))
        assert int(found.argmax()) == row
        page.click("#tab-edit")
        page.locator("#sheet-edit .slider", has_text="Pitch").first.locator("input").focus()
        for _ in range(10):
            page.keyboard.press("ArrowRight")
        page.wait_for_function("avmsf.studio.live.revision > 1 && avmsf.painted() === null")
        page.fill("#sheet-edit input[aria-label='Name of the new field']", "higher")
        page.click("text=Save as")
        page.wait_for_selector("text=Saved:")
        shown = page.evaluate("[...avmsf.studio.bundle.tensors.frequency]")
    (saved,) = (path for path in home.iterdir() if "higher" in path.name)
    factor = 4 ** (10 / 200)
    torch.testing.assert_close(load(saved).bank.frequency, field.bank.frequency * factor, rtol=1e-6, atol=0)
    assert shown == pytest.approx((field.bank.frequency * factor).tolist(), rel=1e-6)


def test_a_capture_of_a_mesh_is_made_by_clicks(browser: "Browser", home: Path, tmp_path: Path) -> None:
    home.mkdir()
    mesh = plate_object("mesh", home)
    assert mesh is not None
    clicked = [(0.06, 0.03, SIDES[2] / 2), (-0.06, -0.03, SIDES[2] / 2)]
    blow = plate_field().render(torch.zeros(1, 3))[0].numpy() * 20
    with opened_page(browser, open_target(mesh), tmp_path / "scratch") as page:
        for number, place in enumerate(clicked, start=1):
            where = page.evaluate("(place) => window.avmsf.project(place)", list(place))
            page.mouse.click(where["x"], where["y"])
            page.set_input_files(
                "#sheet-capture input[type=file]", file_of(wav(blow / abs(blow).max() * 0.5, rate=RATE))
            )
            page.wait_for_selector("#sheet-capture dl")
            page.click("text=Save recording")
            page.wait_for_selector(f"#sheet-capture h2:has-text('{number} impact')")
    capture = read_capture(mesh.with_suffix(""))
    torch.testing.assert_close(capture.impacts.contacts, torch.tensor(clicked).double(), atol=0.005, rtol=0)
    directions = capture.impacts.directions
    assert directions is not None
    torch.testing.assert_close(directions, torch.tensor([[0.0, 0.0, -1.0]] * 2), atol=0.2, rtol=0)
