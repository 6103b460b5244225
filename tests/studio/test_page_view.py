"""The page's pictures in a browser: the object that is hit and painted, the blow's input, spectrum and decay."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from plate_page import LARGER, SIDES, Open, on_screen, plate_table

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.page

MIDDLE = (0.0, 0.0, SIDES[2] / 2)


def page_module(page: "Page", module: str, does: str, given: Any = None) -> Any:
    """Return what a function of one of the page's modules makes of something."""
    load = f'import(new URL("page/{module}.js", document.baseURI))'
    return page.evaluate(f"async (given) => ({does})(await {load}, given)", given)


def thin_plate(count: int, *, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return points that are spread evenly, but irregularly, over both faces of a square plate, and their normals."""
    index = np.arange(count)
    side = np.where(index % 2, 1.0, -1.0)
    lateral = (start + index[:, None] * [0.7548776662, 0.5698402910]) % 1
    points = np.column_stack([lateral, 0.01 * side])
    return points.astype(np.float32), np.column_stack([0 * lateral, side]).astype(np.float32)


def test_the_nearest_contacts_are_found_and_those_of_the_same_side_of_a_wall(plain: "Page") -> None:
    """Contacts drawn on both faces of a plate that is thinner than they are apart, against numpy."""
    points, normals = thin_plate(400)
    places = thin_plate(60, start=0.3)[0] * np.float32([1, 1, 0]) + np.float32([0, 0, 0.01])
    found = page_module(
        plain,
        "contacts",
        """({ Contacts }, { points, normals, places }) => {
          const flat = (values) => Float32Array.from(values.flat());
          const contacts = new Contacts({ points: flat(points), normals: flat(normals) });
          return places.map((place) => [
            contacts.nearest(place).row, contacts.nearestFacing(place, [0, 0, 1]).row, contacts.outward(place)]);
        }""",
        {"points": points.tolist(), "normals": normals.tolist(), "places": places.tolist()},
    )
    distances = np.linalg.norm(points[None].astype(float) - places[:, None], axis=2)
    assert [row for row, _, _ in found] == distances.argmin(axis=1).tolist()
    assert [row for _, row, _ in found] == np.where(normals[:, 2] > 0, distances, np.inf).argmin(axis=1).tolist()
    # Where both faces are about as near, no side is told from the other.
    gaps = np.stack([distances[:, normals[:, 2] == side].min(axis=1) for side in (-1, 1)])
    unclear = gaps.max(axis=0) < 1.5 * gaps.min(axis=0)
    assert unclear.sum() > 5
    assert all(side is None for (_, _, side), it in zip(found, unclear, strict=True) if it)


def test_a_thin_plate_is_painted_on_each_side_by_its_own_contacts(plain: "Page") -> None:
    """One side black, the other white: no position between contacts is gray, with or without normals of its own."""
    points, normals = thin_plate(600)
    positions, sides = thin_plate(300, start=0.3)
    found = page_module(
        plain,
        "paint",
        """async ({ Paint }, given) => {
          const { Contacts } = await import(new URL("page/contacts.js", document.baseURI));
          const [points, normals, positions, sides] = given.map((values) => Float32Array.from(values.flat()));
          const colors = normals.map((_, at) => 127.5 + 127.5 * normals[3 * Math.floor(at / 3) + 2]);
          const mixed = (...own) => [...new Paint(new Contacts({ points, normals }), positions, ...own).mix(colors)];
          return [mixed(sides), mixed()];
        }""",
        [each.tolist() for each in (points, normals, positions, sides)],
    )
    with_normals, without = (np.array(each)[::3] for each in found)
    np.testing.assert_allclose(with_normals, np.where(sides[:, 2] > 0, 255, 0), atol=0.01)
    assert np.minimum(without, 255 - without).max() < 0.01


def picture(page: "Page") -> np.ndarray:
    from PIL import Image

    # What was asked for is drawn in the next frame, which takes long on a busy computer.
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_timeout(400)
    box = page.locator("#stage canvas").bounding_box()
    assert box is not None
    shot = page.screenshot(clip={**box, "y": 80, "height": box["height"] - 160})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float)


def test_the_surface_is_shown_struck_and_painted_in_the_place_of_the_object(visit: Open) -> None:
    page = visit(kind="gaussians", surface=True)
    page.evaluate("document.getElementById('hint').hidden = true")
    own = picture(page)
    page.click("text=Show surface")
    page.wait_for_selector("text=Show Gaussians")
    surface = picture(page)
    # It is a tenth larger than the plate, which shows beside the plate's edges.
    assert (np.abs(surface - own).max(axis=2) > 20).mean() > 0.01
    top = (0.6 * SIDES[0], 0.4 * SIDES[1], LARGER * SIDES[2] / 2)
    spot = (0.3 * SIDES[0], 0.2 * SIDES[1], LARGER * SIDES[2] / 2)
    assert page.evaluate("(at) => avmsf.pick(...at)", on_screen(page, top)) is None
    hit = page.evaluate("(at) => avmsf.pick(...at)", on_screen(page, spot))
    np.testing.assert_allclose(hit["place"], spot, atol=1e-4)
    page.mouse.click(*on_screen(page, spot))
    assert page.evaluate("avmsf.studio.row") == hit["row"]
    contact = plate_table().points[hit["row"]].numpy()
    assert np.linalg.norm(contact - spot) < 0.006  # meters: contacts are .008 apart
    page.evaluate("for (const mark of document.querySelectorAll('.mark')) mark.style.display = 'none'")
    page.click("#tab-modes")
    page.click("tr[data-mode='1']")
    page.evaluate("document.getElementById('legend').style.visibility = 'hidden'")
    assert (np.abs(picture(page) - surface).max(axis=2) > 40).mean() > 0.02
    page.click("#other-source")
    page.wait_for_selector("text=Show surface")
    assert (np.abs(picture(page) - own).max(axis=2) > 40).mean() > 0.02, "the paint stays on what is shown instead"


def test_a_recorded_impact_is_compared_with_the_model(visit: Open) -> None:
    page = visit(strikes=True)
    page.click("#sheet-strike >> text=100.wav")
    page.wait_for_function("document.getElementById('strike-facts').textContent.includes('recording and model')")
    compared = page.evaluate("(({ recording, model }) => [[...recording], [...model]])(avmsf.studio.spectra.compared)")
    recording, model = np.array(compared)
    # Its recording is the model's own sound: a picture of both shows one line, with its peaks at the modes' pitches.
    near = recording > recording.max() - 60
    np.testing.assert_allclose(model[near], recording[near], atol=0.1)
    peak = 40 * 500 ** (float(recording.argmax() + 0.5) / len(recording))
    assert min(abs(peak - 400 * order) for order in range(1, 7)) < 0.02 * peak
    assert page.locator(".mark .dot[data-impact]").count() == 2
    assert page.locator(".mark .dot[data-impact].chosen").count() == 1
    page.uncheck("text=Show them on the object")
    assert page.locator(".mark .dot[data-impact]").count() == 0
