"""The plate's page in a browser of its own, what the tests do there, and answers in the server's place."""

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import soundfile

from page_plate import RATE, lay_out, plate_object, plate_strikes, plate_table

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

FIELD_ABILITIES = ["locate", "edit", "save", "like"]
LIVE = {"revision": 1, "undo": False, "abilities": FIELD_ABILITIES, "mode": "field", "rows": [0, 1, 2, 3, 4, 5]}
LIVE |= {"materials": ["ceramic", "glass", "wood", "iron", "steel"], "jobKind": None}
Serve = Callable[..., str]
Open = Callable[..., "Page"]


def plate_site(serve: Callable[[Path], str], tmp_path_factory: pytest.TempPathFactory) -> Serve:
    """Return a function that gives the address of the plate's page; the same one twice for the same wishes."""
    known: dict[str, str] = {}

    def address(
        kind: str = "points", *, surface: bool = False, strikes: bool = False, live: dict[str, Any] | None = None
    ) -> str:
        name = repr((kind, surface, strikes, live))
        if name not in known:
            folder = tmp_path_factory.mktemp("page")
            table = plate_table()
            files = tmp_path_factory.mktemp("object")
            seen = {"object": plate_object(kind, files), "surface": plate_object("surface", files) if surface else None}
            measured = plate_strikes(table) if strikes else None
            known[name] = serve(lay_out(folder / "site", table, strikes=measured, live=live, **seen))
        return known[name]

    return address


@contextlib.contextmanager
def visiting(browser: "Browser", site: Serve) -> Iterator[Open]:
    """Yield a function that opens the plate's page in a browser of its own, after `before(page)`."""
    with contextlib.ExitStack() as opened:

        def visit(*, before: Callable[["Page"], Any] | None = None, viewport: Any = None, **wishes: Any) -> "Page":
            context = browser.new_context(viewport=viewport or {"width": 900, "height": 600})
            opened.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(10_000)
            if before is not None:
                before(page)
            page.goto(site(**wishes))
            page.evaluate("window.avmsf.ready.then(() => null)")
            return page

        yield visit


def on_screen(page: "Page", place: Any) -> tuple[float, float]:
    where = page.evaluate("(place) => window.avmsf.project(place)", [float(value) for value in place])
    return where["x"], where["y"]


def words_on(page: "Page", kind: str = ".word") -> str:
    return " ".join(page.locator(f"#words {kind}").all_inner_texts())


def wav(seconds: float = 0.5) -> bytes:
    memory = io.BytesIO()
    time = np.arange(round(seconds * RATE)) / RATE
    soundfile.write(memory, 0.5 * np.exp(-9 * time) * np.sin(2600 * time), round(RATE), "PCM_16", format="WAV")
    return memory.getvalue()


def upload(name: str = "blow.wav", content: bytes | None = None) -> Any:
    return {"name": name, "mimeType": "audio/wav", "buffer": wav() if content is None else content}


def answer(route: "Route", content: Any, status: int = 200) -> None:
    route.fulfill(status=status, content_type="application/json", body=json.dumps(content))
