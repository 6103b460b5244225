"""The page changes a field: nothing that a slider says is lost, no other tab's change is overwritten."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from avmsf.export.sampled_field import SampledField
from plate_page import LIVE, Open, Serve, answer, lay_out, plate_table, upload, words_on

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, Request, Route


pytestmark = pytest.mark.page


class EditServer:
    """Answers the page's changes as the studio does, one tab among others, and remembers what it was asked."""

    def __init__(self, page: "Page", first: dict[str, Any], edited: dict[str, Any], live: dict[str, Any]) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.revision, self.taken = 1, set[str]()
        self.state: tuple[dict[str, Any], dict[str, Any]] = ({}, first)
        """The sliders, and the manifest of what is heard."""
        self.past: list[tuple[dict[str, Any], dict[str, Any]]] = []
        self.edited, self.live = edited["manifest"], live
        self.slow = False
        """Whether answers to edits wait until `let_go`."""
        self.then: Callable[[], None] | None = None
        """What happens once between the next answer and what the page fetches upon it."""
        self._waiting: list[Callable[[], None]] = []
        self._let_go = False
        """Whether a lead's events are told as soon as they are asked for: they may be asked for after `let_go`."""
        page.route("**/manifest.json", lambda route: answer(route, self.manifest()))
        page.route("**/edited.bin", lambda route: route.fulfill(body=edited["content"]))
        page.route("**/jobs/j9/events", self._tell)
        for what in ("edit", "undo", "save"):
            page.route(f"**/{what}", self.hear)
        page.route("**/lead?base=*", self.hear_lead)

    def manifest(self) -> dict[str, Any]:
        sliders, shown = self.state
        now = {"revision": self.revision, "undo": bool(self.past), "sliders": sliders}
        return {**shown, "live": {**LIVE, **self.live, **now}}

    def change(self, **sliders: Any) -> None:
        """Do what an edit does, of this tab or another one."""
        self.past.append(self.state)
        self.state = (sliders, self.edited)
        self.revision += 1

    def let_go(self) -> None:
        self.slow, self._let_go = False, True
        while self._waiting:
            self._waiting.pop(0)()

    def _tell(self, route: "Route") -> None:
        if self._let_go:
            self._lead(route)
        else:
            self._waiting.append(lambda: self._lead(route))

    def hear(self, route: "Route", request: "Request") -> None:
        what, words = request.url.rsplit("/", 1)[1], request.post_data_json
        self.asked.append((what, words))
        if words["base"] != self.revision:
            answer(route, {"error": "another tab has changed the field", "revision": self.revision}, 409)
        elif what == "save" and words["name"] in self.taken:
            answer(route, {"error": f"{words['name']} is there: choose another"}, 409)
        else:
            self._do(what, words)
            done = {"revision": self.revision, "remarks": [], **({"file": words["name"]} if what == "save" else {})}
            if self.then is not None:
                self.then()
                self.then = None
            if self.slow and what == "edit":
                self._waiting.append(lambda: answer(route, done))
            else:
                answer(route, done)

    def hear_lead(self, route: "Route", request: "Request") -> None:
        base = int(request.url.rsplit("=", 1)[1])
        self.asked.append(("lead", {"base": base}))
        if base != self.revision:
            answer(route, {"error": "another tab has changed the field", "revision": self.revision}, 409)
        else:
            answer(route, {"job": "j9"}, 202)

    def _do(self, what: str, words: dict[str, Any]) -> None:
        if what == "edit":
            self.change(**{name: value for name, value in words.items() if name != "base"})
            return
        self.revision += 1
        if what == "undo":
            self.state = self.past.pop()
        else:
            self.taken.add(words["name"])
            self.state = ({}, self.state[1])

    def _lead(self, route: "Route") -> None:
        self.change()
        last = json.dumps({"revision": self.revision, "remarks": []})
        route.fulfill(content_type="text/event-stream", body=f"data: {last}\n\n")


@pytest.fixture
def edits(visit: Open, site: Serve, tmp_path: Path) -> Callable[..., tuple["Page", EditServer]]:
    """Return a function that opens the page's tab of edits, with its server."""

    def bundle_of(table: SampledField, name: str) -> dict[str, Any]:
        folder = lay_out(tmp_path / name, table)
        return {
            "manifest": json.loads((folder / "manifest.json").read_text()),
            "content": (folder / "field.bin").read_bytes(),
        }

    first, edited = bundle_of(plate_table(), "first"), bundle_of(plate_table(pitch=1.25), "edited")
    for tensor in edited["manifest"]["tensors"].values():
        tensor["file"] = "edited.bin"

    def opened(**live: Any) -> tuple["Page", EditServer]:
        servers: list[EditServer] = []
        page = visit(live=LIVE, before=lambda page: servers.append(EditServer(page, first["manifest"], edited, live)))
        page.click("#tab-edit")
        return page, servers[0]

    return opened


def slider(page: "Page", name: str) -> "Locator":
    return page.locator("#sheet-edit .slider", has_text=name).first


def move(page: "Page", name: str) -> None:
    """Move a slider by one step to the right."""
    slider(page, name).locator("input").focus()
    page.keyboard.press("ArrowRight")


def shown(page: "Page", *names: str) -> list[str]:
    """Return what sliders say."""
    return [slider(page, name).locator("output").inner_text() for name in names]


def wait_until(page: "Page", true: Callable[[], bool]) -> None:
    for _ in range(100):
        if true():
            return
        page.wait_for_timeout(50)
    raise AssertionError("waited in vain")


def pitch_of_page(page: "Page") -> float:
    """Return the first mode's pitch in what the page would play now, Hz."""
    page.wait_for_function("avmsf.studio.engine.bundle === avmsf.studio.bundle")
    sound = page.evaluate("avmsf.renderOffline([{ row: 0 }], 0.5).then((sound) => [...sound])")
    spectrum = np.abs(np.fft.rfft(np.hanning(len(sound)) * np.array(sound)))
    return float(np.argmax(spectrum[: round(700 * 0.5)]) / 0.5)


STEP = 4.0 ** (1 / 200)
"""Pitch of one step to the right."""


def test_an_edit_is_heard_undone_and_saved(edits: Any) -> None:
    page, server = edits()
    assert pitch_of_page(page) == pytest.approx(400.0, abs=3)
    move(page, "Pitch")
    page.wait_for_function("avmsf.studio.revision === 2 && avmsf.studio.last !== undefined")
    what, words = server.asked[0]
    assert (what, words["base"], words["size"], words["modes"], words["material"]) == ("edit", 1, 1.0, [], None)
    assert words["pitch"] == pytest.approx(STEP, rel=1e-6)
    assert pitch_of_page(page) == pytest.approx(500.0, abs=3)
    page.click("#sheet-edit >> text=Undo")
    page.wait_for_function("avmsf.studio.revision === 3")
    assert pitch_of_page(page) == pytest.approx(400.0, abs=3)
    assert shown(page, "Pitch") == ["× 1.00"], "the sliders go back with the field"
    assert page.is_disabled("#sheet-edit >> text=Undo")
    page.fill("#sheet-edit input[type=text]", "higher")
    page.click("text=Save as")
    page.wait_for_selector("text=Saved: higher")
    page.click("text=Save as")
    page.wait_for_selector("text=higher is there: choose another")
    assert [(what, words["base"]) for what, words in server.asked] == [
        ("edit", 1),
        ("undo", 2),
        ("save", 3),
        ("save", 4),
    ]


@pytest.mark.parametrize("act", ["slider", "save", "undo"])
def test_another_tabs_edit_is_shown_and_not_overwritten(edits: Any, act: str) -> None:
    page, server = edits()
    move(page, "Decay time")
    page.wait_for_function("avmsf.studio.revision === 2")
    server.change(size=2.0)
    if act == "slider":
        move(page, "Pitch")
    elif act == "save":
        page.fill("#sheet-edit input[type=text]", "mine")
        page.click("text=Save as")
    else:
        page.click("#sheet-edit >> text=Undo")
    page.wait_for_selector("text=Another tab has changed this field")
    assert (server.revision, server.taken, server.state[0]) == (3, set(), {"size": 2.0})
    assert shown(page, "Size", "Pitch") == ["× 2.00", "× 1.00"]
    assert pitch_of_page(page) == pytest.approx(500.0, abs=3)
    move(page, "Pitch")
    page.wait_for_function("avmsf.studio.revision === 4")
    last = server.asked[-1][1]
    assert (last["base"], last["size"]) == (3, 2.0), "on top of the other tab's"


def test_another_tabs_edit_right_after_ones_own_is_told_and_kept(edits: Any) -> None:
    page, server = edits()
    server.then = lambda: server.change(size=2.0, pitch=1.0)
    move(page, "Pitch")
    page.wait_for_selector("text=Another tab has changed this field")
    assert shown(page, "Size", "Pitch") == ["× 2.00", "× 1.00"]
    assert [words["base"] for _, words in server.asked] == [1]


def test_undo_waits_for_the_edit_that_it_undoes(edits: Any) -> None:
    page, server = edits()
    move(page, "Size")
    page.wait_for_function("avmsf.studio.revision === 2")
    server.slow = True
    move(page, "Pitch")
    wait_until(page, lambda: len(server.asked) == 2)
    page.click("#sheet-edit >> text=Undo")
    page.wait_for_timeout(100)
    server.let_go()
    page.wait_for_function("avmsf.studio.revision === 4")
    assert [(what, words["base"]) for what, words in server.asked] == [("edit", 1), ("edit", 2), ("undo", 3)]
    assert shown(page, "Size", "Pitch") == ["× 1.01", "× 1.00"]
    assert words_on(page) == ""


def test_leading_takes_the_sliders_along_and_holds_them_meanwhile(edits: Any) -> None:
    page, server = edits()
    move(page, "Pitch")
    page.set_input_files("#sheet-edit input[type=file]", upload())
    page.wait_for_selector("#sheet-edit button:visible:has-text('Stop')")
    assert [sorted(words)[0] for _, words in server.asked] == ["base", "base"], "the slider first, then the recording"
    assert server.asked[0][1]["pitch"] == pytest.approx(STEP)
    assert slider(page, "Pitch").locator("input").is_disabled()
    assert page.is_disabled("#sheet-edit >> text=Undo")
    server.let_go()
    page.wait_for_function("avmsf.studio.revision === 3")
    assert shown(page, "Pitch") == ["× 1.00"]
    move(page, "Size")
    page.wait_for_function("avmsf.studio.revision === 4")
    assert (server.asked[-1][1]["pitch"], server.asked[-1][1]["base"]) == (1.0, 3)


def test_a_lead_under_way_is_followed_by_a_page_opened_later(edits: Any) -> None:
    page, server = edits(job="j9", jobKind="lead", abilities=["edit", "like", "reconstruct"])
    assert page.locator("#sheet-edit button:visible", has_text="Stop").count() == 1
    assert slider(page, "Pitch").locator("input").is_disabled()
    server.let_go()
    page.wait_for_function("avmsf.studio.revision === 2")
    assert not slider(page, "Pitch").locator("input").is_disabled()
    assert pitch_of_page(page) == pytest.approx(500.0, abs=3)


def test_an_answer_that_is_cut_is_no_success(edits: Any) -> None:
    page, server = edits()

    def cut(route: "Route", request: "Request") -> None:
        server.change(**{name: value for name, value in request.post_data_json.items() if name != "base"})
        route.fulfill(status=200, content_type="application/json", body='{"revi')
        page.unroute("**/edit", cut)

    page.route("**/edit", cut)
    move(page, "Pitch")
    page.wait_for_selector("text=The server does not answer")
    page.click("text=Try again")
    page.wait_for_selector("text=or your last change was made although its answer was lost")
    assert server.revision == 2
    assert shown(page, "Pitch") == ["× 1.01"]


def test_an_edit_that_is_refused_is_taken_back(edits: Any) -> None:
    page, server = edits()
    refuse = {"error": "pitch: expected modes below half the sample rate"}
    page.route("**/edit", lambda route: answer(route, refuse, 422))
    move(page, "Pitch")
    page.wait_for_selector("text=expected modes below half the sample rate")
    page.fill("#sheet-edit input[type=text]", "mine")
    page.click("text=Save as")
    page.wait_for_timeout(200)
    assert server.taken == set(), "what is not heard is not saved"
    page.click("text=Revert it")
    assert shown(page, "Pitch") == ["× 1.00"]


def test_what_an_object_is_of_changes_nothing_by_itself(edits: Any) -> None:
    page, server = edits()
    page.get_by_label("Present material").select_option("wood")
    page.wait_for_timeout(500)
    assert server.asked == []
    move(page, "Pitch")
    page.wait_for_function("avmsf.studio.revision === 2")
    page.get_by_label("Present material").select_option("iron")
    page.wait_for_timeout(500)
    assert [words["material"] for _, words in server.asked] == [None], "the pitch is the same of any material"
    move(page, "Size")
    page.wait_for_function("avmsf.studio.revision === 3")
    page.get_by_label("Present material").select_option("steel")
    page.wait_for_function("avmsf.studio.revision === 4")
    assert [words["material"] for _, words in server.asked[1:]] == [
        {"from": "iron", "to": None},
        {"from": "steel", "to": None},
    ]
