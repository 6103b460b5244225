"""A page that was exported needs no network: the libraries that draw the object go with it."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from PIL import Image

from avmsf.export.web import write_webpage
from plate_page import plate_object, plate_table, words_on

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.page
WATCH = "window.refused = []; addEventListener('securitypolicyviolation', (e) => refused.push(e.violatedDirective));"


@pytest.mark.parametrize(("kind", "name"), [("gaussians", "page.html"), ("mesh", "folder")])
def test_a_page_shows_and_plays_the_object_without_a_network(
    browser: "Browser", kind: str, name: str, tmp_path: Path, serve: Callable[[Path], str]
) -> None:
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
    assert page.evaluate("avmsf.studio.view !== null && avmsf.studio.view !== undefined")
    page.wait_for_timeout(500)
    with Image.open(io.BytesIO(page.locator("#stage").screenshot())) as picture:
        assert len(picture.convert("RGB").getcolors(maxcolors=1 << 24)) > 20
    assert page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => Math.max(...sound))") > 0
    assert page.evaluate("refused") == []
    assert [each for each in asked if not each.startswith((address, "data:", "blob:"))] == []
    context.close()
