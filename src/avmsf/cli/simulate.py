"""`avmsf simulate`: objects whose modes and gains are known, struck, recorded and photographed."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli import INTERRUPTED
from avmsf.cli.objectbar import ObjectBar
from avmsf.cli.printing import console, print_text, say, table
from avmsf.errors import SimulationError
from avmsf.simulate.example import EXAMPLE
from avmsf.simulate.material import MATERIALS
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.shapes import KINDS
from avmsf.simulate.sim20 import NON_SYMMETRIC, SET, SIM20, sim20_recipe
from avmsf.simulate.simulationset import SetProgress, simulate_set


@dataclass(frozen=True)
class Options:
    """Simulate objects, how they sound and how they look, as capture folders with their truth.

    `avmsf simulate sim-20 --output FOLDER` makes the benchmark set, one folder an object; what is whole is kept, so
    that an interrupted run goes on with the same command. One object of the set by its name, any other by --kind or
    --mesh, goes into FOLDER itself.
    """

    what: tyro.conf.Positional[str | None] = None
    """sim-20 for the benchmark set, the name of one of its objects, or example for the one that `avmsf demo` is about;
    nothing for an object of your own."""
    output: Path | None = None
    """Folder to make."""
    list: bool = False
    """List the set's objects, the shapes and the materials, and make nothing."""
    cache: Path | None = None
    """Folder to keep elastic modes in, which take most of the time: other hammers, noises and views then go quickly."""
    recipe: Annotated[ObjectRecipe, tyro.conf.arg(name="")] = field(default_factory=ObjectRecipe)
    """The object, and how it is struck, heard and seen; of an object of the set, what shall be different."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    options = _parsed(words, ObjectRecipe())
    # A second time from the named object's recipe: what is asked for may be a default, and not that object's.
    recipe = None if options.list else _recipe_of(options.what)
    return options if recipe is None else _parsed(words, recipe)


def run(options: Options) -> int:
    """Simulate; return 130 where Ctrl-C stopped it."""
    if options.list:
        _list()
        return 0
    if options.output is None:
        raise SimulationError("expected --output FOLDER, where to put what is simulated; --list shows what there is")
    recipes, folder = _chosen(options, options.output)
    try:
        with ObjectBar() as bar:

            def show(progress: SetProgress) -> None:
                bar.show(f"{progress.name}: {progress.stage}", done=progress.done, total=progress.total)

            simulate_set(recipes, folder, cache=options.cache, progress=show)
    except KeyboardInterrupt:
        say("avmsf simulate: interrupted; the same command goes on from where it was")
        return INTERRUPTED
    print_text(f"wrote {options.output}" if len(recipes) == 1 else f"wrote {len(recipes)} objects to {options.output}")
    return 0


def _parsed(words: Sequence[str], recipe: ObjectRecipe) -> Options:
    default = Options(recipe=recipe)
    return tyro.cli(Options, prog="avmsf simulate", args=words, default=default, config=(tyro.conf.FlagCreatePairsOff,))


def _recipe_of(what: str | None) -> ObjectRecipe | None:
    """Return the named object's recipe; None for the whole set and for an object of the user's own."""
    if what in (None, SET):
        return None
    return EXAMPLE if what == "example" else sim20_recipe(what)


def _chosen(options: Options, output: Path) -> tuple[dict[str, ObjectRecipe], Path]:
    """Return the recipes by their folders' names, and the folder that holds these."""
    if options.what == SET:
        for name in ("kind", "mesh", "material", "seed"):
            if getattr(options.recipe, name) != getattr(ObjectRecipe(), name):
                raise SimulationError(f"--{name} was given with {SET}, whose objects have their own: leave it out")
        changes = {
            each.name: getattr(options.recipe, each.name)
            for each in fields(ObjectRecipe)
            if getattr(options.recipe, each.name) != getattr(ObjectRecipe(), each.name)
        }
        return {name: replace(recipe, **changes) for name, recipe in SIM20.items()}, output
    place = output.resolve()
    return {place.name: options.recipe}, place.parent


def _list() -> None:
    screen = console(errors=False)
    rows = [
        (name, recipe.kind, recipe.material, str(recipe.seed), "yes" if name not in NON_SYMMETRIC else "no")
        for name, recipe in SIM20.items()
    ]
    screen.print(table(SET, ("object", "shape", "material", "seed", "symmetric by turns"), rows, words=3))
    print_text(f"shapes for --kind: {', '.join(KINDS)}")
    print_text(f"materials: {', '.join(MATERIALS)}")
