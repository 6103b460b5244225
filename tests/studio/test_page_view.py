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
CORNER = (0.1, 0.06, SIDES[2] / 2)


def in_module(page: "Page", module: str, does: str, given: Any = None) -> Any:
    """Return what a function of one of the page's modules, and of three, makes of something."""
    return page.evaluate(
        f"""async (given) => {{
              const three = await import("three");
              const module = await import(new URL("page/{module}.js", document.baseURI));
              return ({does})(module, given, three);
            }}""",
        given,
    )


BUMPY = """(three, width, height) => {
  const ball = new three.SphereGeometry(1, width, height).toNonIndexed();
  const corners = ball.attributes.position.array;
  for (let at = 0; at < corners.length; at++) corners[at] *= 1 + 0.2 * Math.sin(5 * corners[at - at % 3]);
  return corners;
}"""


def test_a_ray_meets_the_nearest_triangle_of_all(plain: "Page") -> None:
    """Against three's own search of every triangle, from outside and from within."""
    found = in_module(
        plain,
        "triangletree",
        f"""({{ TriangleTree }}, _, three) => {{
          const corners = ({BUMPY})(three, 40, 20);
          const geometry = new three.BufferGeometry();
          geometry.setAttribute("position", new three.BufferAttribute(corners, 3));
          const mesh = new three.Mesh(geometry, new three.MeshBasicMaterial({{ side: three.DoubleSide }}));
          const tree = new TriangleTree(corners);
          const rays = Array.from({{ length: 300 }}, (_, n) => {{
            const origin = new three.Vector3(Math.sin(n), Math.cos(2 * n), Math.sin(3 * n)).multiplyScalar(n % 3 + 0.2);
            const aim = new three.Vector3(Math.cos(5 * n), Math.sin(7 * n), Math.cos(n * n)).multiplyScalar(0.9);
            return [origin, aim.sub(origin).normalize()];
          }});
          return rays.map(([origin, direction]) => {{
            const [first] = new three.Raycaster(origin, direction).intersectObject(mesh);
            return [tree.distance(origin.toArray(), direction.toArray()), first?.distance ?? Infinity];
          }});
        }}""",
    )
    ours, theirs = np.array(found, dtype=float).T
    assert np.isfinite(ours).sum() > 100
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)


def test_the_nearest_contacts_are_found(plain: "Page") -> None:
    draw = np.random.default_rng(0)
    points = draw.normal(size=(400, 3)).astype(np.float32)
    points[:, 2] *= 0.05
    places = 2 * draw.normal(size=(60, 3))
    found = in_module(
        plain,
        "nearest",
        """({ PointGrid }, { points, places }) => {
          const grid = new PointGrid(Float32Array.from(points.flat()));
          return places.map((place) => grid.nearest(...place, 5).map(({ row, distance }) => [row, distance]));
        }""",
        {"points": points.tolist(), "places": places.tolist()},
    )
    distances = np.linalg.norm(points[None].astype(float) - places[:, None], axis=2)
    rows = np.argsort(distances, axis=1)[:, :5]
    np.testing.assert_array_equal(np.array(found)[:, :, 0], rows)
    np.testing.assert_allclose(np.array(found)[:, :, 1], np.take_along_axis(distances, rows, 1), rtol=1e-12)


def test_finer_triangles_cover_the_same_surface_without_gaps(plain: "Page") -> None:
    """A box: as much surface, normals along for the ride, no edge too long, every edge met by two triangles."""
    found = in_module(
        plain,
        "subdivide",
        """({ subdivide }, longest, three) => {
          const box = new three.BoxGeometry(1, 0.6, 0.1).toNonIndexed();
          const { position, normal } = box.attributes;
          const fine = subdivide(
            { position: { array: position.array, size: 3 }, normal: { array: normal.array, size: 3 } }, longest, 5000);
          return [Array.from(fine.position.array), Array.from(fine.normal.array)];
        }""",
        0.1,
    )
    corners, normals = (np.array(each).reshape(-1, 3, 3) for each in found)
    sides = np.roll(corners, -1, axis=1) - corners
    crossed = np.cross(sides[:, 0], sides[:, 1])
    assert np.linalg.norm(sides, axis=2).max() <= 0.1
    assert np.linalg.norm(crossed, axis=1).sum() / 2 == pytest.approx(2 * (0.6 + 0.1 + 0.06), rel=1e-5)
    outward = crossed / np.linalg.norm(crossed, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, outward[:, None].repeat(3, axis=1), atol=1e-4)
    edges: dict[frozenset[tuple[float, ...]], int] = {}
    for triangle in corners.round(5) + 0.0:
        for one, other in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            edge = frozenset((tuple(one), tuple(other)))
            edges[edge] = edges.get(edge, 0) + 1
    assert set(edges.values()) == {2}


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
    painted = picture(page)
    assert (np.abs(painted - surface).max(axis=2) > 40).mean() > 0.02
    page.click("#other-look")
    page.wait_for_selector("text=Show surface")
    # The paint stays on what is shown instead, and comes off all.
    assert (np.abs(picture(page) - own).max(axis=2) > 40).mean() > 0.02
    page.evaluate("document.getElementById('unpaint').click()")
    assert (np.abs(picture(page) - own).max(axis=2) > 40).mean() < 1e-4
    page.click("#other-look")
    page.wait_for_selector("text=Show Gaussians")
    assert (np.abs(picture(page) - surface).max(axis=2) > 40).mean() < 1e-4


def turned(page: "Page") -> bool:
    """Drag beside the object, and return whether that turned it."""
    before = on_screen(page, CORNER)
    page.mouse.move(40, 500)
    page.mouse.down()
    page.mouse.move(140, 500, steps=4)
    page.mouse.up()
    page.wait_for_timeout(50)
    return bool(np.hypot(*np.subtract(on_screen(page, CORNER), before)) > 10)


def test_sound_comes_at_the_press_and_the_object_can_be_turned_afterwards(visit: Open) -> None:
    """Also where the press ends over the panel, after the view was reset."""
    page = visit()
    page.check("text=Sound at the press")
    page.click("#look")
    page.mouse.move(*on_screen(page, MIDDLE))
    page.mouse.down()
    assert page.evaluate("avmsf.studio.last.force") == 1
    page.mouse.move(880, 300, steps=3)
    page.mouse.up()
    assert turned(page)
    page.mouse.move(*on_screen(page, MIDDLE))
    page.mouse.down()
    page.evaluate("document.querySelector('#stage canvas').dispatchEvent(new PointerEvent('pointercancel'))")
    assert page.evaluate("avmsf.studio.view.controls.enabled")
    page.mouse.up()


def test_a_pen_strikes_as_hard_as_it_is_pressed(plain: "Page") -> None:
    page = plain
    page.click("#look")
    x, y = on_screen(page, MIDDLE)
    session = page.context.new_cdp_session(page)
    for force in (0.75, 0.25):
        event = {"x": x, "y": y, "button": "left", "clickCount": 1, "pointerType": "pen", "force": force}
        session.send("Input.dispatchMouseEvent", {**event, "type": "mousePressed", "buttons": 1})
        session.send("Input.dispatchMouseEvent", {**event, "type": "mouseReleased", "force": 0})
        assert page.evaluate("avmsf.studio.last.force") == pytest.approx(2 * force, rel=0.05)


def test_force_mallet_and_volume_are_heeded(visit: Open) -> None:
    page = visit()
    force = page.locator(".slider", has_text="Force of a click").locator("input")
    force.fill("200")
    page.click("text=Strike at random")
    assert page.evaluate("avmsf.studio.last.force") == pytest.approx(20)
    page.click("text=Felt")
    assert page.evaluate("avmsf.studio.last.contactTime") == 0.012
    page.click("text=As recorded")
    assert page.evaluate("avmsf.studio.last.contactTime") is None
    before = page.evaluate("avmsf.studio.engine.level")
    page.locator(".slider", has_text="Volume").locator("input").fill("200")
    assert page.evaluate("avmsf.studio.engine.level") == pytest.approx(4 * before)


INKED = """(name) => {
  const canvas = document.getElementById(name);
  const ink = (token) => {
    const pencil = new OffscreenCanvas(1, 1).getContext("2d");
    pencil.fillStyle = getComputedStyle(canvas).getPropertyValue(token).trim();
    pencil.fillRect(0, 0, 1, 1);
    return [...pencil.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  const { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  const close = (place, color, alpha) =>
    data[4 * place + 3] > alpha && color.every((value, at) => Math.abs(value - data[4 * place + at]) < 24);
  const columns = (token, alpha) => {
    const color = ink(token);
    const highest = new Array(width).fill(null);
    for (let place = 0; place < width * height; place++)
      if (highest[place % width] === null && close(place, color, alpha))
        highest[place % width] = Math.floor(place / width) / height;
    return highest;
  };
  return { width, first: columns("--first", 100), second: columns("--second", 25), faint: columns("--faint", 100) };
}"""


def columns(page: "Page", canvas: str, ink: str) -> np.ndarray:
    """Return how far down a canvas each column's highest pixel of an ink is, 0 to 1; nan where it has none."""
    return np.array(page.evaluate(INKED, canvas)[ink], dtype=float)


def column_of(page: "Page", share: float) -> int:
    """Return the column of a share of a chart's axis, as its margins have it."""
    width = int(page.evaluate("document.getElementById('spectrum').width"))
    return round(34 + share * (width - 34 - 8))


def share_of(frequency: float) -> float:
    return float(np.log(frequency / 40) / np.log(20_000 / 40))


def test_spectrum_and_decay_show_the_modes_that_were_struck(visit: Open) -> None:
    page = visit()
    # The model alone, a tenth of a second after the blow, for as long as it takes to look.
    page.evaluate(
        """() => {
             const { spectra, modes } = avmsf.studio;
             spectra.listen(modes, null);
             avmsf.strike([-0.12, -0.08, 0.01]);
             const now = performance.now();
             performance.now = () => now + 100;
           }"""
    )
    page.wait_for_timeout(200)
    first, faint = (columns(page, "spectrum", ink) for ink in ("first", "faint"))
    stems = [column_of(page, share_of(400.0 * order)) for order in range(1, 7)]
    for column in stems:
        # Each has fallen since, the higher the further; where it was stays to be read beside the panel's paper.
        assert np.nanmin(faint[column - 1 : column + 2]) < np.nanmin(first[column - 1 : column + 2]) - 0.01
    beside = np.ones(len(first), dtype=bool)
    for column in stems:
        beside[column - 2 : column + 3] = False
    assert np.isnan(first[beside]).all(), "a stem stands at a mode and nowhere else"
    seconds = 80 / (20 / np.log(10) * 4)
    curve = columns(page, "decay", "first")
    early, late = (np.nanmin(curve[column_of(page, t / seconds) - 6 :][:12]) for t in (0.5, 1.5))
    # The slowest mode falls by 35 dB a second; the canvas has 80 dB over 76 of its 104 pixels.
    assert late - early == pytest.approx(20 / np.log(10) * 4 / 80 * 76 / 104, rel=0.15)
