"""A shared page takes three and spark from a network: the very files that it was tried with, or none."""

import base64
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from avmsf.export.webpage import IMPORT_MAP, write_webpage
from avmsf.studio.modules import PINNED
from page_plate import PAGE, plate_object, plate_table
from plate_page import words_on

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

NETWORK = "https://cdn.jsdelivr.net/npm/"
TAMPERED = "three.core.js"
HEARD = "window.refused = []; addEventListener('securitypolicyviolation', (e) => refused.push(e.violatedDirective));"


def digests() -> dict[str, str]:
    """Return what the page's import map says that each file's content must be."""
    found = IMPORT_MAP.search((PAGE / "index.html").read_text())
    assert found is not None
    known: dict[str, str] = json.loads(found[2])["integrity"]
    return known


def local(address: str, modules: Path) -> Path:
    path = address.removeprefix(NETWORK)
    for package, version in PINNED.items():
        path = path.replace(f"{package}@{version}/", f"{package}/", 1)
    return modules / path


def opened(page: "Page", address: str, modules: Path, *, tampered: str | None = None) -> list[str]:
    """Open the page with the network's files taken from here, and return which it asked for."""
    asked = []

    def serve(route: "Route") -> None:
        asked.append(route.request.url)
        content = local(route.request.url, modules).read_bytes()
        changed = tampered is not None and route.request.url.endswith(tampered)
        headers = {"Content-Type": "text/javascript", "Access-Control-Allow-Origin": "*"}
        route.fulfill(body=content + b"\nwindow.evil = 1;" if changed else content, headers=headers)

    page.route(f"{NETWORK}**", serve)
    page.goto(address)
    page.evaluate("window.avmsf.ready.then(() => null)")
    return asked


def test_the_import_map_knows_each_file_by_its_content(modules: Path) -> None:
    for address, digest in digests().items():
        found = hashlib.sha384(local(address, modules).read_bytes()).digest()
        assert digest == f"sha384-{base64.b64encode(found).decode()}", address


@pytest.mark.parametrize(("kind", "name"), [("mesh", "page.html"), ("gaussians", "page.html"), ("mesh", "folder")])
def test_every_file_that_the_page_fetches_is_known(
    browser: "Browser", modules: Path, kind: str, name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    write_webpage(plate_table(), tmp_path / name, object=plate_object(kind, tmp_path))
    place = (tmp_path / name).as_uri()
    if name == "folder":
        place = request.getfixturevalue("serve")(tmp_path / name)
    page = browser.new_page()
    page.add_init_script(HEARD)
    asked = opened(page, place, modules)
    assert page.evaluate("avmsf.studio.view !== null && avmsf.studio.view !== undefined")
    assert page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => Math.max(...sound))") > 0
    assert page.evaluate("refused") == []
    page.evaluate(
        "() => { const script = document.createElement('script'); script.textContent = 'window.evil = 1';"
        "document.body.append(script); document.body.insertAdjacentHTML('beforeend',"
        '\'<img src="x:" onerror="window.evil = 2">\');'
        "return new Promise((done) => setTimeout(done, 200)) }"
    )
    assert page.evaluate("window.evil ?? null") is None
    assert {"script-src-elem", "script-src-attr"} <= set(page.evaluate("refused"))
    assert asked
    assert set(asked) <= digests().keys()
    page.close()


def test_another_content_is_not_run_and_the_panel_works_without(
    browser: "Browser", modules: Path, tmp_path: Path
) -> None:
    write_webpage(plate_table(), tmp_path / "page.html", object=plate_object("mesh", tmp_path))
    page = browser.new_page()
    opened(page, (tmp_path / "page.html").as_uri(), modules, tampered=TAMPERED)
    assert page.evaluate("window.evil ?? null") is None
    assert "three and spark" in words_on(page)
    assert page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => Math.max(...sound))") > 0
    page.close()


def test_a_page_without_a_network_says_what_is_missing_and_the_rest_works(browser: "Browser", tmp_path: Path) -> None:
    write_webpage(plate_table(), tmp_path / "page.html", object=plate_object("mesh", tmp_path))
    page = browser.new_page()
    page.route(f"{NETWORK}**", lambda route: route.abort())
    page.goto((tmp_path / "page.html").as_uri())
    page.evaluate("window.avmsf.ready.then(() => null)")
    said = words_on(page)
    assert "three and spark, which draw the object, could not be loaded from the network" in said
    assert "buttons in the panel" in said
    assert "base64" not in said, "browsers say in full which module they could not fetch, and here that is all of it"
    assert "http.server" not in said, "one file needs no server"
    page.click("text=Strike at random")
    assert page.evaluate("avmsf.studio.last.force") == 1
    page.close()


def test_a_folder_that_is_opened_without_a_server_says_so(
    browser: "Browser", modules: Path, tmp_path: Path, serve: Callable[[Path], str]
) -> None:
    write_webpage(plate_table(), tmp_path / "folder")
    page = browser.new_page()
    page.goto((tmp_path / "folder" / "index.html").as_uri())
    page.wait_for_timeout(300)
    assert page.inner_text("h1") == "Nothing to show"
    for words in ("from a web server", "python -m http.server", "--to web --output page.html"):
        assert words in words_on(page)
    opened(page, serve(tmp_path / "folder"), modules)
    assert page.inner_text("h1") == "Plate"
    assert words_on(page) == ""
    page.close()
