"""`avmsf demo`: a complete example, as the commands that a user would give."""

import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options import Common
from avmsf.cli.output import show
from avmsf.cli.paths import New, OutputError
from avmsf.simulate.recipe import EXAMPLE, EXAMPLE_FOLDER

BEGUN = ".begun"
"""Folder in the demo's that the example is first copied to; it stays as the mark of a demo."""
# A quarter of the Gaussians' usual steps: the field's error is the same within the variation of runs.
COMMANDS = (
    "check {0}/capture",
    "fit {0}/capture --train-count 12 --set splat.steps=500 --output {0}/mug.safetensors",
    "fit {0}/capture --until gaussians --set splat.steps=500 --output {0}/mug.ply --overwrite",
    "fit {0}/capture --until surface --set splat.steps=500 --output {0}/mug-surface.ply --overwrite",
    "info {0}/mug.safetensors --capture {0}/capture --plots {0}/pictures",
    "render {0}/mug.safetensors --contact-table {0}/capture/impacts.csv -o {0}/sounds --overwrite --normalize peak",
    "export {0}/mug.safetensors --to web --capture {0}/capture --object {0}/mug.ply --output {0}/mug.html --overwrite",
)


@dataclass(frozen=True)
class Options(Common):
    """Run a complete example: from photographs and recordings of a mug to its sound field, sounds and images.

    A ceramic mug, made by `avmsf simulate example`: 48 photographs and 16 impacts. Gaussians are fitted to the
    photographs, and the mug's shape is reconstructed from both. A field is fitted to 12 of the impacts, which also
    determine the thickness of the mug's wall, and tested on the other 4. With --json each command prints its object.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER"), New()]] = Path("demo")
    """Folder for all results, new, empty, or of an earlier or interrupted demo, which goes on from where it was."""
    resumes = True

    def _check(self) -> None:
        if self.folder.is_dir() and any(self.folder.iterdir()) and not (self.folder / BEGUN).is_dir():
            wanted, advice = "a new or empty folder, or an earlier demo's", "choose another"
            raise OutputError.expected(wanted, "one with files", file=self.folder, advice=advice)


def run(options: Options) -> int:
    """Run the commands one by one; return the code of the first that fails."""
    # This module is imported with the package of all verbs half done.
    from avmsf.cli import main

    folder = options.folder
    if not (folder / "capture").is_dir():
        begun = folder / BEGUN / "capture"
        shutil.copytree(EXAMPLE_FOLDER, begun, dirs_exist_ok=True)
        begun.rename(folder / "capture")
    given = {"--quiet": options.only_results, "--verbose": options.verbose, "--json": options.json}
    common = [name for name, present in given.items() if present]
    for command in COMMANDS:
        words = shlex.split(command.format(shlex.quote(str(folder))))
        if not options.only_results:
            show(f"\n$ avmsf {shlex.join(words)}")
        code = main([*words, *common])
        if code:
            return code
    show(closing_words(folder))
    return 0


def closing_words(folder: Path) -> str:
    """Return what a finished demo in `folder` has made, and what to try next."""
    place = shlex.quote(str(folder))
    # Its path where the shell does not find it.
    own = "avmsf" if shutil.which("avmsf") or Path(sys.argv[0]).name != "avmsf" else shlex.quote(sys.argv[0])
    return f"""
From photographs of a mug and recordings of 12 impacts, avmsf fitted a model of its sound, which predicts the sound of
an impact anywhere on the mug; the table of its fit has the errors at the other 4. The mug is simulated, with noise, and
its wall is {1000 * (EXAMPLE.thickness or 0.0):.2g} mm thick. The model knows neither the mesh nor the wall.

Open {folder / "mug.html"} in a browser and click the mug to strike it.
  {folder / "sounds"}: the model's sounds of all recorded impacts; {folder / "pictures"}: spectrograms of both
  {folder / "mug-surface.ply"}: the mug's surface, reconstructed from the photographs
  {folder / "capture"}: the input; record your own object in the same way

Next, try:
  {own} render {place}/mug.safetensors --position 0.04 0 0.05 -o impact.wav   # an impact anywhere, in meters
  {own} locate {place}/mug.safetensors {place}/capture/001.wav   # the contact of a recording
  {own} fit YOUR_FOLDER --output yours.safetensors   # your own object"""
