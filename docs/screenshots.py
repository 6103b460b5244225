"""Draw the studio's pictures of this documentation anew: `python docs/screenshots.py`, from a checkout."""

import io
import shutil
import subprocess
import sys
import tempfile
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import soundfile

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from avmsf.simulate.simulation_folder import example_mesh, write_textured
from benchmarks.browser import AVMSF, WIDE, chromium, opened, studio

PICTURES = Path(__file__).resolve().parent / "pictures" / "studio"
NARROW, TALL = {"width": 390, "height": 780}, {"width": 1280, "height": 1000}
RINGING_MILLISECONDS = 300
MAX_PICTURE_BYTES = 200_000


def draw(folder: Path) -> None:
    """Draw the real studio with the example capture's field into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as scratch,
        as_file(files("avmsf") / "example") as example,
        chromium() as browser,
    ):
        capture, field, empty = (Path(scratch) / name for name in ("example", "example.safetensors", "new object"))
        shutil.copytree(example, capture)
        write_textured(example_mesh(), capture)
        words = ("fit", str(capture), "--gain-model", "smooth", "--output", str(field))
        subprocess.run([*AVMSF, *words], check=True, capture_output=True)
        with studio(str(field), "--capture", str(capture)) as (_, address, _):
            _draw_field(browser, address, capture, folder)
        empty.mkdir()
        shutil.copy(capture / "surface.ply", empty)
        with studio(str(empty)) as (_, address, _):
            _draw_capture(browser, address, capture, folder)
    for path in sorted(folder.glob("*.png")):
        size = path.stat().st_size
        if size > MAX_PICTURE_BYTES:
            raise RuntimeError(f"{path}: {size} bytes, expected at most {MAX_PICTURE_BYTES}")


def _draw_field(browser: Any, address: str, capture: Path, folder: Path) -> None:
    # The edit comes last: what it makes of the field is seen by every page opened after it.
    for name, viewport, context in (
        ("dark", WIDE, {"color_scheme": "dark"}),
        ("narrow", NARROW, {}),
        ("strike", WIDE, {}),
    ):
        with opened(browser, address, viewport, **context) as loaded:
            place = loaded.evaluate("window.avmsf.project(window.avmsf.studio.view.controls.target.toArray())")
            loaded.mouse.click(place["x"] + 30, place["y"] + 20)
            # The first impact starts the browser's sound.
            loaded.wait_for_function("window.avmsf.studio.engine.context.state === 'running'")
            loaded.wait_for_timeout(1000)
            _shoot(loaded, folder / f"{name}.png", ringing=True)
            if name == "strike":
                loaded.click("#tab-modes")
                loaded.click("tbody tr >> nth=2")
                _shoot(loaded, folder / "modes.png", ringing=True)
                loaded.click("#tab-find")
                loaded.set_input_files("#sheet-find input[type=file]", str(capture / "003.wav"))
                loaded.wait_for_selector("#sheet-find dl", timeout=120_000)
                _shoot(loaded, folder / "find.png", ringing=True)
                loaded.click("#unpaint")
                loaded.click("#tab-edit")
                loaded.select_option("#sheet-edit select >> nth=1", "wood")
                loaded.wait_for_function("window.avmsf.studio.revision > 1", timeout=60_000)
                _shoot(loaded, folder / "edit.png", ringing=True)


def _draw_capture(browser: Any, address: str, recorded: Path, folder: Path) -> None:
    with opened(browser, address, TALL) as loaded:
        for number, (right, down) in enumerate(((-40, 30), (50, -20), (0, 60)), start=1):
            place = loaded.evaluate("window.avmsf.project(window.avmsf.studio.view.controls.target.toArray())")
            loaded.mouse.click(place["x"] + right, place["y"] + down)
            # As loud as a recording should be: the example's are all far from full scale.
            samples, rate = soundfile.read(recorded / f"{number:03d}.wav")
            memory = io.BytesIO()
            soundfile.write(memory, samples * 0.5 / abs(samples).max(), rate, "FLOAT", format="WAV")
            upload = {"name": f"{number:03d}.wav", "mimeType": "audio/wav", "buffer": memory.getvalue()}
            loaded.set_input_files("#sheet-capture input[type=file]", upload)
            loaded.wait_for_selector("#sheet-capture dl")
            if number < 3:
                loaded.click("text=Save recording")
                loaded.wait_for_function(f"document.querySelectorAll('#sheet-capture .listing li').length === {number}")
        _shoot(loaded, folder / "capture.png")


def _shoot(loaded: Any, path: Path, *, ringing: bool = False) -> None:
    """Write a picture; `ringing`, of the moment in which the object is struck again."""
    loaded.mouse.move(5, 300)
    loaded.wait_for_timeout(400)
    if ringing:
        loaded.evaluate("window.avmsf.strike(window.avmsf.studio.row)")
        loaded.wait_for_timeout(RINGING_MILLISECONDS)
    loaded.screenshot(path=str(path))


if __name__ == "__main__":
    draw(PICTURES)
