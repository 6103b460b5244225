"""The page in a browser: what is clicked is struck, what is painted is true, and recordings meet their model."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from plate_page import LARGER, SIDES, Open, on_screen, plate_shapes, plate_table, words_on

if TYPE_CHECKING:
    from playwright.sync_api import Page


pytestmark = pytest.mark.page

SPACING = SIDES[0] / 30
"""Between neighboring contacts, meters."""


def last_place(page: "Page") -> torch.Tensor:
    """Return where the last blow fell, meters."""
    return torch.tensor(page.evaluate("avmsf.studio.contacts.position(avmsf.studio.last.row)"))


@pytest.mark.parametrize("kind", ["mesh", "gaussians", "points"])
def test_a_click_strikes_the_contact_that_it_shows_and_a_mode_is_painted_by_its_gain(visit: Open, kind: str) -> None:
    page = visit(kind=kind)
    for place in [(0.0, 0.0, 0.01), (0.09, 0.05, 0.01), (-0.085, -0.045, 0.01)]:
        page.mouse.click(*on_screen(page, place))
        # The plate is thinner than contacts are apart, so the wrong face would be as near.
        assert (last_place(page) - torch.tensor(place)).norm() < SPACING
    page.mouse.click(30, 550)
    assert (last_place(page) - torch.tensor(place)).norm() < SPACING, "beside the object nothing is struck"
    expect_painted(page, kind)


def test_dragging_turns_and_does_not_strike(page: "Page") -> None:
    page.click("#reset-view")
    x, y = on_screen(page, (0.0, 0.0, 0.01))
    before, before_row = on_screen(page, (0.1, 0.0, 0.01)), page.evaluate("avmsf.studio.last?.row")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y, steps=4)
    page.mouse.up()
    assert page.evaluate("avmsf.studio.last?.row") == before_row
    assert np.hypot(*np.subtract(on_screen(page, (0.1, 0.0, 0.01)), before)) > 20


def test_a_longer_press_strikes_harder(page: "Page") -> None:
    page.click("#reset-view")
    page.mouse.move(*on_screen(page, (0.0, 0.0, 0.01)))
    forces = []
    for milliseconds in (0, 600, 1450):
        page.mouse.down()
        page.wait_for_timeout(milliseconds)
        page.mouse.up()
        forces.append(page.evaluate("avmsf.studio.last.force"))
    assert forces[0] == 1.0
    assert 1.5 < forces[1] < 9.0
    assert forces[2] == 10.0
    # An average impact's is in newtons where the field knows it.
    page.evaluate("Object.assign(avmsf.studio.bundle.manifest, { perNewton: true, backgroundForce: 147 })")
    page.mouse.down()
    page.mouse.up()
    assert page.inner_text("#strike-facts").endswith(", 150 N")
    page.evaluate("Object.assign(avmsf.studio.bundle.manifest, { perNewton: false, backgroundForce: null })")


def test_keys_turn_and_strike_what_is_in_the_middle(page: "Page") -> None:
    page.click("#reset-view")
    page.locator("#stage canvas").focus()
    before = on_screen(page, (0.1, 0.0, 0.01))
    page.keyboard.press("Enter")
    # The eye looks at the plate's middle from 0.75, -1, 0.85, and meets its face on the way.
    met = torch.tensor([0.75, -1.0, 0.85]) * 0.01 / 0.85
    assert (last_place(page) - met).norm() < SPACING
    page.keyboard.press("Shift+Enter")
    assert page.evaluate("avmsf.studio.last.force") == 10
    page.keyboard.press("ArrowRight")
    assert np.hypot(*np.subtract(on_screen(page, (0.1, 0.0, 0.01)), before)) > 5


def expect_painted(page: "Page", kind: str) -> None:
    page.click("#tab-modes")
    page.click("tr[data-mode='2']")
    painted = page.evaluate("(({ values, colors }) => ({ values: [...values], colors: [...colors] }))(avmsf.painted())")
    values, shape = torch.tensor(painted["values"]), plate_shapes(plate_table().points)[:, 2]
    sign = torch.sign(values @ shape)
    torch.testing.assert_close(values * sign, shape, atol=1e-6, rtol=0)
    colors = torch.tensor(painted["colors"]).reshape(-1, 3)
    # One end of the scale is red, the other blue; and the picture has them where the shape is greatest.
    high, low = int(values.argmax()), int(values.argmin())
    assert colors[high, 0] > 1.5 * colors[high, 2]
    assert colors[low, 2] > 1.5 * colors[low, 0]
    page.wait_for_timeout(900 if kind == "gaussians" else 150)
    corner = torch.tensor([0.112, 0.072, 0.01])
    for turn in (1.0, -1.0):
        place = corner * torch.tensor([1.0, turn, 1.0])
        positive = bool(plate_shapes(place[None])[0, 2] * sign > 0)
        red, blue = pixel(page, *on_screen(page, place))
        assert (red > blue) == positive
        assert max(red, blue) > 1.3 * min(red, blue)
    page.click("#unpaint")
    assert page.evaluate("avmsf.painted()") is None


def pixel(page: "Page", x: float, y: float) -> tuple[float, float]:
    """Return red and blue of the screen about a place."""
    from PIL import Image

    shot = page.screenshot(clip={"x": x - 2, "y": y - 2, "width": 4, "height": 4})
    colors = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=float).mean(axis=(0, 1))
    return float(colors[0]), float(colors[2])


def test_the_table_tells_pitch_decay_and_level_at_the_contact(page: "Page") -> None:
    row = page.evaluate("avmsf.strike([-0.12, -0.08, 0.01])")
    page.click("#tab-modes")
    cells = [float(text) for text in page.locator("tr[data-mode='3'] td").all_inner_texts()]
    table = plate_table()
    level = 20 * float((table.gains[row, 3].abs() / table.gains[row].abs().max()).log10())
    assert cells == pytest.approx([4, 1600.0, 6.9078 / 16.0, level], abs=0.06)
    page.click("th[data-column='level'] button")
    first = page.locator("tbody tr").first.get_attribute("data-mode")
    assert first == str(int(table.gains[row].abs().argmax()))


def block_webgl(page: "Page") -> None:
    page.add_init_script(
        """const get = HTMLCanvasElement.prototype.getContext;
           HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
             return kind.startsWith("webgl") ? null : get.call(this, kind, ...more);
           };"""
    )


def block_audio(page: "Page") -> None:
    page.add_init_script("delete window.AudioContext; delete window.AudioWorkletNode;")


@pytest.mark.parametrize(
    ("before", "said"),
    [
        (block_webgl, "This browser shows no 3D"),
        (lambda page: page.route("**/vendor/**", lambda route: route.abort()), "imported module"),
        (block_audio, "No sound"),
    ],
    ids=["webgl", "three", "audio"],
)
def test_what_the_browser_lacks_is_said_and_the_rest_works(visit: Open, before: Any, said: str) -> None:
    page = visit(before=before)
    assert said in words_on(page, ".bad")
    page.click("text=Strike at random")
    assert page.evaluate("avmsf.studio.last.force") == 1
    page.click("#tab-modes")
    assert page.locator("tbody tr").count() == 6


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


def test_the_nearest_contacts_are_found_and_those_of_the_same_side_of_a_wall(page: "Page") -> None:
    """Contacts drawn on both faces of a plate that is thinner than they are apart, against numpy."""
    points, normals = thin_plate(400)
    places = thin_plate(60, start=0.3)[0] * np.float32([1, 1, 0]) + np.float32([0, 0, 0.01])
    found = page_module(
        page,
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


def test_a_thin_plate_is_painted_on_each_side_by_its_own_contacts(page: "Page") -> None:
    """One side black, the other white: no position between contacts is gray, with or without normals of its own."""
    points, normals = thin_plate(600)
    positions, sides = thin_plate(300, start=0.3)
    found = page_module(
        page,
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
