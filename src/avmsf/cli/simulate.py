"""`avmsf simulate`: objects whose modes and gains are known, struck, recorded and photographed."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli import INTERRUPTED
from avmsf.cli.common import Configured, Flag
from avmsf.cli.paths import CacheFolder, Existing, OutputFolder
from avmsf.cli.printing import display, next_command, print_json, print_result, say, show, table
from avmsf.cli.settings import with_settings
from avmsf.errors import SimulationError
from avmsf.fem.material import MATERIALS
from avmsf.simulate.recipe import EXAMPLE, NON_SYMMETRIC, SETS, ObjectRecipe, named_recipe

_IDENTITY = ("kind", "mesh", "material", "seed")
"""What distinguishes the objects of the set."""


@dataclass(frozen=True)
class Options(Configured):
    """Simulate objects, their recordings and images, as capture folders with ground truth.

    `avmsf simulate sim-20 --output FOLDER` makes a benchmark set, one folder per object. It skips complete objects, so
    repeat an interrupted command to continue it. A single object, of the set by its name or any other by --kind or
    --mesh, is written to FOLDER itself.
    """

    what: tyro.conf.Positional[Annotated[str | None, tyro.conf.arg(metavar="NAME")]] = None
    """sim-20 or held-out for a set, one of its objects, or example; nothing for an object of your own."""
    output: OutputFolder = None
    """Output folder."""
    list: Flag = False
    """Only list the sets' objects, the shapes and the materials."""
    cache: CacheFolder = None
    """Cache of elastic modes, which take most of the time."""
    kind: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Shape; --list names them."""
    mesh: Annotated[
        Path | None, tyro.conf.arg(metavar="MESH"), Existing("a mesh: obj, ply, glb or stl", ("a mesh or Gaussians",))
    ] = None
    """A mesh or scan instead of a shape, in meters."""
    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name in the table of materials; --list names them."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Random seed of the proportions, the contacts, the noise and the imperfections."""
    impacts: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Number of impacts; by default 40."""
    seconds: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Length of each recording that is used, from its onset, by default 2 s."""
    sample_rate: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Sample rate, Hz; by default 48000."""
    thickness: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Wall thickness, meters; by default drawn at random for a shape, and none (solid) for a mesh."""
    size: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Longest side of the bounding box, meters."""
    views: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Images to render on three circles: a multiple of 3, by default 72; 0 for none."""

    usual = ObjectRecipe()

    def applied(self, recipe: ObjectRecipe) -> ObjectRecipe:
        """Return a recipe with the settings and options that are given; of a set's object what it is stays."""
        names = (*_IDENTITY, "impacts", "seconds", "sample_rate", "thickness", "size", "views")
        made = with_settings(recipe, self.set, self.config, {name: getattr(self, name) for name in names})
        return replace(made, **{name: getattr(recipe, name) for name in _IDENTITY}) if self.what in SETS else made

    @cached_property
    def all_settings(self) -> ObjectRecipe:
        """The recipe of a single object."""
        return self.applied(_recipe_of(self.what))

    def check_inputs(self) -> None:
        """Raise `InputError` for a mesh that does not exist, `SimulationError` for options that do not fit."""
        super().check_inputs()
        if self.output is None and not self.list:
            raise SimulationError.expected("a folder", name="output", advice="--list names the objects")
        _ = self.all_settings
        named = {each.partition("=")[0].strip() for each in self.set}
        for name in _IDENTITY if self.what in SETS else ():
            if getattr(self, name) is not None or name in named:
                advice = "leave it out"
                raise SimulationError.expected(f"none with {self.what}", got="one", name=name, advice=advice)


def _recipe_of(what: str | None) -> ObjectRecipe:
    """Return the named object's recipe; for the whole set and for an object of the user's own the usual one."""
    if what is None or what in SETS:
        return ObjectRecipe()
    return EXAMPLE if what == "example" else named_recipe(what)


def run(options: Options) -> int:
    """Simulate; return 130 where Ctrl-C stopped it."""
    from avmsf.simulate.simulation_folder import simulate_set

    if options.list:
        _list(json=options.json)
        return 0
    assert options.output is not None
    recipes, folder = _chosen(options, options.output)
    try:
        simulate_set(recipes, folder, cache=options.cache, progress=display.objects())
    except KeyboardInterrupt:
        say("avmsf simulate: interrupted; repeat the command to continue", always=True)
        return INTERRUPTED
    text = f"wrote {options.output}" if len(recipes) == 1 else f"wrote {len(recipes)} objects to {options.output}"
    values = {"output": str(options.output), "objects": [str(folder / name) for name in recipes]}
    print_result(text, values, json=options.json)
    next_command("avmsf check", folder / next(iter(recipes)))
    return 0


def _chosen(options: Options, output: Path) -> tuple[dict[str, ObjectRecipe], Path]:
    """Return the recipes by their folders' names, and the folder that holds these."""
    if options.what in SETS:
        return {name: options.applied(recipe) for name, recipe in SETS[options.what].items()}, output
    place = output.resolve()
    return {place.name: options.all_settings}, place.parent


def _list(*, json: bool) -> None:
    from avmsf.simulate.shapes import KINDS

    rows = [
        (title, name, recipe.kind, recipe.material, str(recipe.seed), "no" if name in NON_SYMMETRIC else "yes")
        for title, objects in SETS.items()
        for name, recipe in objects.items()
    ]
    columns = ("set", "object", "shape", "material", "seed", "rotational symmetry")
    shapes = f"shapes for --kind: {', '.join(KINDS)}\nmaterials: {', '.join(MATERIALS)}"
    show(f"{table('objects', columns, rows, words=4)}\n{shapes}", json=json)
    if json:
        names = [name for objects in SETS.values() for name in objects]
        print_json({"objects": names, "shapes": list(KINDS), "materials": list(MATERIALS)})
