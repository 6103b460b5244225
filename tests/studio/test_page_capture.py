"""The page records: what was heard is kept until the server has it, and lands where it was struck and nowhere else."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from plate_page import LIVE, SIDES, Open, answer, on_screen, upload, words_on

if TYPE_CHECKING:
    from playwright.sync_api import Page, Request, Route

pytestmark = pytest.mark.page

SPACING = SIDES[0] / 30
"""Between neighboring contacts, meters."""
FOLDER = "/captures/plate"
LIVE_CAPTURE = {
    "revision": 1,
    "undo": False,
    "abilities": ["capture", "reconstruct"],
    "mode": "capture",
    "folder": FOLDER,
}
HERE, THERE = (0.04, 0.04, 0.01), (-0.04, 0.0, 0.01)

LOUD_MICROPHONE = """
    navigator.mediaDevices.getUserMedia = async () => {
      await new Promise((allowed) => setTimeout(allowed, 300));
      const context = new AudioContext();
      const heard = new MediaStreamAudioDestinationNode(context, { channelCount: 1 });
      const sine = new OscillatorNode(context, { frequency: 500 });
      sine.connect(new GainNode(context, { gain: 1.5 })).connect(heard);
      sine.start();
      (window.streams ||= []).push(heard.stream);
      return heard.stream;
    };
    window.messages = 0;
    window.AudioWorkletNode = class extends AudioWorkletNode {
      constructor(...all) {
        super(...all);
        this.port.addEventListener("message", () => window.messages++);
      }
    };"""
"""One that has to be allowed first, and is overdriven by a tone from the very beginning."""
ADDRESSES = """
    window.addresses = new Set();
    const [create, revoke] = [URL.createObjectURL, URL.revokeObjectURL];
    URL.createObjectURL = (what) => {
      const address = create.call(URL, what);
      if (what.type === "audio/wav") addresses.add(address);
      return address;
    };
    URL.revokeObjectURL = (address) => (addresses.delete(address), revoke.call(URL, address));"""
STORED = """
    new Promise((resolve) => {
      const opened = indexedDB.open("avmsf-outbox", 1);
      opened.onsuccess = () => {
        const all = opened.result.transaction("recordings").objectStore("recordings").getAll();
        all.onsuccess = () => resolve(all.result.map(({ owner, kept }) => [owner, kept]));
      };
    })"""


class Strikes:
    """Answers capture mode as the studio does, for one page."""

    def __init__(self, page: "Page") -> None:
        self.strikes: list[dict[str, Any]] = []
        self.asked: list[tuple[str, str, str | None]] = []
        self.sent: list[tuple[str, str]] = []
        self.broken = False
        """Whether the line is cut after an impact was written."""
        page.route("**/capture", lambda route: answer(route, self.describe()))
        page.route("**/capture/check", lambda route: answer(route, self.report()))
        page.route("**/capture/strikes?**", self.add)
        page.route("**/capture/strikes/**", self.change)

    def describe(self) -> dict[str, Any]:
        return {"folder": FOLDER, "strikes": self.strikes, "problems": [], "ready": True}

    def report(self, **more: Any) -> dict[str, Any]:
        report = {"seconds": 0.5, "peak_db": -6.0, "clipped": 0, "onset_seconds": 0.004, "warnings": []}
        return {**report, **more}

    def add(self, route: "Route", request: "Request") -> None:
        words = request.url.split("?")[1]
        query = dict(part.split("=") for part in words.split("&"))
        if (words, str(request.post_data_buffer)) in self.sent:
            answer(route, self.strikes[-1], 201)
            return
        self.sent.append((words, str(request.post_data_buffer)))
        contact = [float(query[axis]) for axis in "xyz"]
        file = f"{len(self.strikes) + 1:03d}.wav"
        self.strikes.append(self.report(file=file, contact=contact, direction=None, row=0, digest="d1"))
        if self.broken:
            route.abort()
        else:
            answer(route, self.strikes[-1], 201)

    def change(self, route: "Route", request: "Request") -> None:
        file, match = request.url.rsplit("/", 1)[1], request.headers.get("if-match")
        self.asked.append((request.method, file, match))
        (strike,) = (each for each in self.strikes if each["file"] == file)
        if match != strike["digest"]:
            answer(route, {"error": f"{file}: expected {strike['digest']}, found {match}"}, 409)
        elif request.method == "DELETE":
            self.strikes.remove(strike)
            answer(route, {})
        else:
            strike["digest"] += "+"
            answer(route, strike)


@pytest.fixture
def capturing(visit: Open) -> Callable[..., tuple["Page", Strikes]]:
    """Return a function that opens the page in capture mode, and gives it with what answers it."""

    def capture(script: str = "") -> tuple["Page", Strikes]:
        servers: list[Strikes] = []

        def before(page: "Page") -> None:
            servers.append(Strikes(page))
            page.add_init_script(script)

        return visit(live=LIVE_CAPTURE, before=before), servers[0]

    return capture


def take(page: "Page", place: tuple[float, float, float]) -> None:
    """Click a place and attach its recording."""
    page.mouse.click(*on_screen(page, place))
    attach(page)


def attach(page: "Page") -> None:
    page.set_input_files("#sheet-capture input[type=file]", upload())
    page.wait_for_selector("#sheet-capture dl")


def strike_once(page: "Page") -> None:
    take(page, HERE)
    page.click("text=Save recording")
    page.wait_for_selector("text=1 impact")


def test_a_recording_outlives_a_broken_connection_and_a_reload(capturing: Any) -> None:
    page, server = capturing()
    server.broken = True
    take(page, HERE)
    page.click("text=Save recording")
    page.wait_for_selector("text=The recording is not lost")
    assert page.locator("text=waits for the server").count() == 1
    server.broken = False
    page.reload()
    page.wait_for_selector("text=1 impact")
    page.wait_for_function("!document.body.textContent.includes('waits for the server')")
    assert len(server.strikes) == 1, "sent again as it was"
    assert page.evaluate(STORED) == []


def test_a_capture_is_reconstructed(capturing: Any) -> None:
    page, _ = capturing()
    events = ('{"stage": "fit", "done": 3, "total": 9}', '{"field": "/captures/plate/field"}')
    body = "".join(f"id: {number}\ndata: {event}\n\n" for number, event in enumerate(events))
    page.route("**/reconstruct", lambda route: answer(route, {"job": "j1"}, 202))
    page.route("**/jobs/j1/events", lambda route: route.fulfill(content_type="text/event-stream", body=body))
    assert page.is_disabled("text=● Record")
    assert page.is_disabled("text=Reconstruct the field")
    strike_once(page)
    take(page, THERE)
    page.click("text=Save recording")
    page.wait_for_selector("text=2 impacts")
    page.click("text=Reconstruct the field")
    page.wait_for_selector("text=The sound field is ready.")
    assert page.locator("text=Field saved: /captures/plate/field").count() == 1


def test_a_recording_that_was_not_kept_waits_when_the_next_is_made(capturing: Any) -> None:
    page, server = capturing(ADDRESSES)
    take(page, HERE)
    take(page, THERE)
    page.wait_for_selector("text=is not saved yet")
    assert "waits below" in words_on(page)
    assert page.evaluate(STORED) == [[FOLDER, False]] * 2, "under a name that outlives the server and its secret"
    for _ in range(2):
        page.click("text=Listen >> nth=0")
    page.wait_for_function("addresses.size === 0")
    page.click(".main:has-text('Save recording')")
    page.wait_for_selector("text=1 impact")
    page.reload()
    page.wait_for_selector("#sheet-capture dl")
    page.click(".main:has-text('Save recording')")
    page.wait_for_selector("text=2 impacts")
    for strike, place in zip(server.strikes, (THERE, HERE), strict=True):
        assert strike["contact"] == pytest.approx(place, abs=SPACING)
    assert page.evaluate(STORED) == []


def test_a_recording_belongs_where_it_was_begun_and_ends_by_itself(capturing: Any) -> None:
    page, server = capturing(LOUD_MICROPHONE)
    page.mouse.click(*on_screen(page, HERE))
    page.dblclick("text=● Record")
    page.wait_for_function("window.streams?.[0].getTracks()[0].readyState === 'ended'")
    assert page.inner_text("#sheet-capture .main >> nth=0") == "● Record"
    assert page.locator("#sheet-capture dl").count() == 0, "what was stopped before it began is no recording"

    page.click("text=● Record")
    page.wait_for_selector("text=impact detected")
    page.mouse.click(*on_screen(page, THERE))
    page.wait_for_selector("text=The contact cannot change")
    assert page.is_disabled("#sheet-capture .place input >> nth=0")
    page.wait_for_selector("text=Clipped")
    page.wait_for_selector("#sheet-capture dl")
    assert page.evaluate("streams.map((stream) => stream.getTracks()[0].readyState)") == ["ended", "ended"]
    seconds = float(page.inner_text("#sheet-capture small >> nth=0").split()[0])
    assert 3.0 <= seconds < 3.5, "it goes on for three seconds after the blow"
    assert 0.8 * 50 * seconds < page.evaluate("messages") < 1.2 * 50 * seconds
    page.click("text=Save recording")
    page.wait_for_selector("text=1 impact")
    assert server.strikes[0]["contact"] == pytest.approx(HERE, abs=SPACING)

    page.click("[aria-label='Record 001.wav again']")
    page.wait_for_selector("text=Cancel")
    page.click("text=● Record")
    page.wait_for_selector("text=impact detected")
    assert page.is_hidden("text=Cancel")
    page.click("text=■ Stop")
    with page.expect_response("**/capture/strikes/001.wav"):
        page.click("button:text-is('Replace')")
    assert server.asked == [("PUT", "001.wav", "d1")]


def test_another_tabs_strike_is_neither_overwritten_nor_taken_out(capturing: Any) -> None:
    page, server = capturing()
    strike_once(page)
    page.click("[aria-label='Record 001.wav again']")
    attach(page)
    server.strikes[0] |= {"digest": "theirs", "peak_db": -12.3}
    page.click("button:text-is('Replace')")
    page.wait_for_selector("text=was rejected: 001.wav: expected theirs, found d1")
    page.wait_for_selector("text=001.wav -12.3 dB")
    assert server.strikes[0]["digest"] == "theirs"
    with page.expect_response("**/capture"):
        page.click("text=Replace it with mine")
    page.wait_for_function("!document.body.textContent.includes('was rejected')")
    assert server.asked[-1] == ("PUT", "001.wav", "theirs")

    server.strikes[0] |= {"digest": "theirs again", "peak_db": -23.4}
    page.on("dialog", lambda dialog: dialog.accept())
    page.click("[aria-label='Remove 001.wav']")
    page.wait_for_selector("text=expected theirs again, found theirs+")
    page.wait_for_selector("text=001.wav -23.4 dB")
    page.click("[aria-label='Remove 001.wav']")
    page.wait_for_selector("text=0 impacts")


def test_the_outbox_promises_only_what_is_written(visit: Open) -> None:
    page = visit()
    seen = page.evaluate(
        """async () => {
             const { Outbox } = await import(new URL("page/outbox.js", location.href));
             const keys = async (owner) => (await Outbox.open(owner)).entries.map(({ key }) => key);
             const box = await Outbox.open("mine");
             await box.put({ key: "b", made: 2 });
             await box.put({ key: "c", made: 1 });
             await (await Outbox.open("theirs")).put({ key: "d", made: 3 });
             const [mine, theirs] = [await keys("mine"), await keys("theirs")];
             const put = IDBObjectStore.prototype.put;
             // The browser says yes, and then finds no room on the disk.
             IDBObjectStore.prototype.put = function (entry) {
               const request = put.call(this, entry);
               request.addEventListener("success", () => this.transaction.abort());
               return request;
             };
             await box.put({ key: "e", made: 4 });
             const { lasting } = box;
             await box.remove("b");
             return { mine, theirs, lasting, here: box.has("e"), left: await keys("mine") };
           }"""
    )
    assert seen == {"mine": ["c", "b"], "theirs": ["d"], "lasting": False, "here": True, "left": ["c"]}


def test_a_place_found_on_another_field_is_not_painted_and_searches_do_not_meet(visit: Open) -> None:
    held: list[Route] = []
    asked: list[int] = []

    def locate(route: "Route", request: "Request") -> None:
        asked.append(len(request.post_data_buffer or b""))
        held.append(route)

    def found(row: int, revision: int) -> dict[str, Any]:
        region = {"probability": 0.9, "radius": 0.01, "surface_fraction": 0.1}
        place = page.evaluate(f"avmsf.studio.contacts.position({row})")
        return {
            "impacts": [{"position": place, "row": row, "probability": "", "credible_region": region}],
            "revision": revision,
        }

    page = visit(live=LIVE, before=lambda page: page.route("**/locate", locate))
    page.click("#tab-find")

    def look_for(name: str) -> None:
        page.set_input_files("#sheet-find input[type=file]", upload(name))

    def wait_for(count: int) -> None:
        page.wait_for_timeout(50)
        for _ in range(100):
            if len(held) >= count:
                return
            page.wait_for_timeout(20)

    for name in ("first.wav", "second.wav", "third.wav"):
        look_for(name)
        wait_for(1)
    assert len(asked) == 1
    answer(held[0], found(1, 1))
    wait_for(2)
    assert "1 impact" not in page.inner_text("#sheet-find"), "nobody waits for the first any more"
    answer(held[1], found(2, 1))
    page.wait_for_selector("text=third.wav: 1 impact")
    assert len(asked) == 2

    look_for("late.wav")
    wait_for(3)
    page.evaluate("avmsf.studio.revision = 2")
    answer(held[2], found(3, 1))
    page.wait_for_selector("text=The field changed while late.wav was located")
    assert "1 impact" not in page.inner_text("#sheet-find"), "what was found before is not what was looked for"
    page.click("text=Locate again")
    wait_for(4)
    answer(held[3], found(4, 2))
    page.wait_for_selector("text=late.wav: 1 impact")


def test_a_recording_that_the_server_refuses_is_not_offered_to_be_kept(capturing: Any) -> None:
    page, _ = capturing()
    silent = {"error": "the recording: expected a blow, found silence: record it again"}
    page.route("**/capture/check", lambda route: answer(route, silent, 422))
    page.mouse.click(*on_screen(page, HERE))
    page.set_input_files("#sheet-capture input[type=file]", upload())
    page.wait_for_selector("text=It cannot be saved: the recording: expected a blow, found silence")
    keep, redo = (page.locator("#sheet-capture button", has_text=words).first for words in ("Save recording", "Redo"))
    assert keep.is_disabled()
    assert "main" not in (keep.get_attribute("class") or "")
    assert "main" in (redo.get_attribute("class") or "")
    redo.click()
    page.unroute("**/capture/check")
    page.route("**/capture/check", lambda route: route.abort())
    page.set_input_files("#sheet-capture input[type=file]", upload())
    page.wait_for_selector("text=Measure again")
    assert keep.is_enabled(), "a server that does not answer has refused nothing"
