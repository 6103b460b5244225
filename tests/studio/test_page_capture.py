"""The page and its studio record: what was recorded is kept until the folder has it, and lands where it belongs."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import soundfile

from avmsf.capture import read_capture
from avmsf.field.store import save
from avmsf.studio.opening import open_target
from plate_page import Open, answer, on_screen, plate_object, upload, words_on
from served import Served, blow, plate_field, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

pytestmark = pytest.mark.page

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
STORED = """
    new Promise((resolve) => {
      const opened = indexedDB.open("avmsf-outbox", 1);
      opened.onsuccess = () => {
        const all = opened.result.transaction("recordings").objectStore("recordings").getAll();
        all.onsuccess = () => resolve(all.result.map(({ owner, kept }) => [owner, kept]));
      };
    })"""


@pytest.fixture
def capturing(serving: Any, visit_studio: Any, tmp_path: Path) -> Callable[..., tuple["Page", Served]]:
    """Return a function that opens a mesh in capture mode, and gives the page and its studio."""

    def capture(script: str = "") -> tuple["Page", Served]:
        server = serving(open_target(plate_object("mesh", tmp_path)))
        return visit_studio(server, lambda page: page.add_init_script(script)), server

    return capture


def impacts(server: Served) -> list[Any]:
    return list(server.get("capture").words["strikes"])


def take(page: "Page", place: tuple[float, float, float], seed: int = 0) -> None:
    """Click a place and attach its recording."""
    page.mouse.click(*on_screen(page, place))
    page.set_input_files("#sheet-capture input[type=file]", upload(content=blow(seed)))
    page.wait_for_selector("#sheet-capture dl")


def test_a_recording_outlives_a_broken_connection_and_a_reload(capturing: Any) -> None:
    page, server = capturing()

    def cut(route: "Route") -> None:
        route.fetch()
        route.abort()

    page.route("**/capture/strikes?**", cut)
    take(page, HERE)
    page.click("text=Save recording")
    page.wait_for_selector("text=The recording is not lost")
    assert page.locator("text=waits for the server").count() == 1
    page.unroute("**/capture/strikes?**")
    page.reload()
    page.wait_for_selector("text=1 impact")
    page.wait_for_function("!document.body.textContent.includes('waits for the server')")
    assert len(impacts(server)) == 1, "sent again as it was"
    assert page.evaluate(STORED) == []


def test_a_capture_is_made_by_clicks_and_reconstructed(capturing: Any, tmp_path: Path) -> None:
    page, server = capturing()
    save(plate_field(), tmp_path / "made")
    result = {"result": {"field": "/captures/plate/field", "output": str(tmp_path / "made")}}
    server.studio.jobs.command = (sys.executable, "-c", f"import json; print(json.dumps({result!r}))")
    assert page.is_disabled("text=● Record")
    assert page.is_disabled("text=Reconstruct the field")
    take(page, HERE)
    page.click("text=Save recording")
    page.wait_for_selector("text=1 impact")
    take(page, THERE, 1)
    page.click("text=Save recording")
    page.wait_for_selector("text=2 impacts")
    recorded = read_capture(tmp_path / "mesh").impacts
    np.testing.assert_allclose(recorded.contacts, [HERE, THERE], atol=0.005)
    np.testing.assert_allclose(recorded.directions, [[0, 0, -1]] * 2, atol=0.2)
    page.click("text=Reconstruct the field")
    page.wait_for_selector("text=The sound field is ready.")
    assert page.locator("text=Field saved: /captures/plate/field").count() == 1


def test_a_recording_that_was_not_saved_waits_when_the_next_is_made(capturing: Any, tmp_path: Path) -> None:
    page, server = capturing()
    take(page, HERE)
    take(page, THERE, 1)
    page.wait_for_selector("text=is not saved yet")
    assert "waits below" in words_on(page)
    folder = str(tmp_path / "mesh")
    assert page.evaluate(STORED) == [[folder, False]] * 2, "under a name that outlives the server and its secret"
    page.click(".main:has-text('Save recording')")
    page.wait_for_selector("text=1 impact")
    page.reload()
    page.wait_for_selector("#sheet-capture dl")
    page.click(".main:has-text('Save recording')")
    page.wait_for_selector("text=2 impacts")
    for impact, place in zip(impacts(server), (THERE, HERE), strict=True):
        assert impact["contact"] == pytest.approx(place, abs=0.003)  # a pixel or two
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
    assert 3.0 <= seconds < 3.5, "it goes on for three seconds after the impact"
    assert 0.8 * 50 * seconds < page.evaluate("messages") < 1.2 * 50 * seconds
    page.click("text=Save recording")
    page.wait_for_selector("text=1 impact")
    [impact] = impacts(server)
    assert impact["contact"] == pytest.approx(HERE, abs=0.003)
    samples, rate = soundfile.read(io.BytesIO(server.get("capture/strikes/001.wav").content))
    spectrum = np.abs(np.fft.rfft(samples[-round(0.2 * rate) :]))
    assert np.argmax(spectrum) / 0.2 == pytest.approx(500, abs=10), "it is the tone that the microphone hears"

    page.click("[aria-label='Record 001.wav again']")
    page.wait_for_selector("text=Cancel")
    page.click("text=● Record")
    page.wait_for_selector("text=impact detected")
    assert page.is_hidden("text=Cancel")
    page.click("text=■ Stop")
    with page.expect_response("**/capture/strikes/001.wav"):
        page.click("button:text-is('Replace')")
    assert impacts(server)[0]["digest"] != impact["digest"]


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


def test_searches_do_not_meet_and_a_contact_on_another_field_is_not_painted(visit: Open) -> None:
    held: list[Route] = []

    def found(row: int, revision: int) -> dict[str, Any]:
        region = {"probability": 0.9, "radius": 0.01, "surface_fraction": 0.1}
        place = page.evaluate(f"avmsf.studio.contacts.position({row})")
        impact = {"position": place, "row": row, "probability": "", "credible_region": region}
        return {"impacts": [impact], "revision": revision}

    def wait_for(count: int) -> None:
        wait_until(lambda: page.wait_for_timeout(20) or len(held) >= count)

    page = visit(live=True, before=lambda page: page.route("**/locate", lambda route: held.append(route)))
    page.click("#tab-find")
    for name in ("first.wav", "second.wav", "third.wav"):
        page.set_input_files("#sheet-find input[type=file]", upload(name))
        wait_for(1)
    answer(held[0], found(1, 1))
    wait_for(2)
    assert "1 impact" not in page.inner_text("#sheet-find"), "nobody waits for the first any more"
    answer(held[1], found(2, 1))
    page.wait_for_selector("text=third.wav: 1 impact")
    assert len(held) == 2

    page.set_input_files("#sheet-find input[type=file]", upload("late.wav"))
    wait_for(3)
    page.evaluate("avmsf.studio.revision = 2")
    answer(held[2], found(3, 1))
    page.wait_for_selector("text=The field changed while late.wav was located")
    assert "1 impact" not in page.inner_text("#sheet-find"), "what was found before is not what was looked for"
    page.click("text=Locate again")
    wait_for(4)
    answer(held[3], found(4, 2))
    page.wait_for_selector("text=late.wav: 1 impact")
