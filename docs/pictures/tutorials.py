"""Draw the pictures of tutorials and guides: `avmsf demo demo`, then `python docs/pictures/tutorials.py demo`.

Commands of these pages draw them from the demo's field and capture, in about five minutes. They are made smaller here.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

PICTURES = Path(__file__).parent / "tutorials"
FIELD, CAPTURE = "mug.safetensors", "capture"
HELD_OUT = f"{CAPTURE}/012.wav"
"""One of the recordings that the demo's field is not fitted to."""
COMMANDS = {
    "modes": ("modes", CAPTURE, "--plots", "{}"),
    "info": ("info", FIELD, "--capture", CAPTURE, "--plots", "{}"),
    "suggest": ("suggest", FIELD, "--output", "{}"),
    "locate": ("locate", FIELD, HELD_OUT, "--output", "{}"),
    "edit": ("edit", FIELD, "--to", "wood", "--output", "{}/wooden.safetensors", "--plots", "{}"),
}
"""Their arguments, with {} for the folder that each writes to."""
DRAWN = {
    "modes": "modes/modes.png",
    "body": "info/surface.png",
    "gains": "info/gains.png",
    "spectrograms": "info/spectrograms.png",
    "uncertainty": "suggest/suggested.png",
    "located": "locate/012.png",
    "edited": "edit/modes.png",
}
"""Names of the pictures, and what the commands call them."""
WIDTH, COLORS = 1100, 256


def main() -> None:
    """Run the commands on the demo in the folder that the command line names, and write the pictures."""
    demo = Path(sys.argv[1])
    PICTURES.mkdir(exist_ok=True)
    with TemporaryDirectory(prefix="avmsf-") as name:
        for folder, arguments in COMMANDS.items():
            (Path(name) / folder).mkdir()
            words = [word.format(f"{name}/{folder}") for word in arguments]
            subprocess.run([sys.executable, "-c", "from avmsf.cli import main; main()", *words], check=True, cwd=demo)
        for picture, path in DRAWN.items():
            image = Image.open(Path(name) / path).convert("RGB")
            image.thumbnail((WIDTH, image.height))
            # Few pixels have the ends of the color maps, which the default method drops.
            few = image.quantize(COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            few.save(PICTURES / f"{picture}.png", optimize=True)


main()
