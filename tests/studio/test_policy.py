"""What the page may run: all that it needs, in a browser that tells of what it refuses, and nothing more."""

from pathlib import Path
from typing import TYPE_CHECKING

from avmsf.studio.guard import policy_of
from avmsf.studio.opening import open_target
from avmsf.studio.routes import PAGE
from opened_plate import open_plate
from plate_page import plate_object
from served import served

if TYPE_CHECKING:
    from playwright.sync_api import Browser

HEARD = "window.refused = []; addEventListener('securitypolicyviolation', (e) => refused.push(e.violatedDirective));"


def test_no_script_of_a_network_is_allowed() -> None:
    policy = policy_of((PAGE / "index.html").read_text())
    scripts = next(part for part in policy.split("; ") if part.startswith("script-src"))
    assert "https:" not in scripts
    assert "unsafe-inline" not in policy
    assert "'unsafe-eval'" not in policy


def test_the_page_needs_no_more_than_it_is_allowed(browser: "Browser", tmp_path: Path) -> None:
    shown = plate_object("gaussians", tmp_path)
    opened = open_plate(tmp_path / "home")
    with served(open_target(opened.field, object=shown), tmp_path / "scratch") as server:
        context = browser.new_context()
        page = context.new_page()
        page.set_default_timeout(30_000)
        page.add_init_script(HEARD)
        page.goto(f"http://127.0.0.1:{server.port}/{server.token}/")
        page.evaluate("window.avmsf.ready.then(() => null)")
        sound = page.evaluate("avmsf.renderOffline([{ row: 5 }]).then((sound) => Math.max(...sound))")
        assert sound > 0
        assert page.evaluate("refused") == []
        page.evaluate(
            "() => { const script = document.createElement('script'); script.textContent = 'window.evil = 1';"
            "document.body.append(script); return new Promise((done) => setTimeout(done, 50)) }"
        )
        assert page.evaluate("[window.evil ?? null, refused]") == [None, ["script-src-elem"]]
        context.close()
