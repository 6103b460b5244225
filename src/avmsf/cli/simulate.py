"""`avmsf simulate`: objects whose modes and gains are known, struck, recorded and photographed."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import tyro

from avmsf._utils.text import counted
from avmsf.cli.options import Configured, Flag, Int, Name, Number, with_settings
from avmsf.cli.output import command, display, finish, table
from avmsf.cli.paths import CacheFolder, Existing, OutputFolder, arg
from avmsf.errors import SimulationError
from avmsf.fem.material import MATERIALS
from avmsf.simulate.recipe import EXAMPLE, NON_SYMMETRIC, SETS, ObjectRecipe, named_recipe

_IDENTITY = ("kind", "mesh", "material", "seed")
"""What distinguishes the objects of the set."""


@dataclass(frozen=True)
class Options(Configured):
    """Simulate objects, their recordings and images, as capture folders with ground truth.

    Of a set (sim-20, held-out) every object gets a folder in the output, and those that are complete are skipped; a
    single object, of a set or by --kind or --mesh, is written to the output itself.
    """

    what: tyro.conf.Positional[Name] = None
    """A set, one of its objects, or example; nothing for your own."""
    output: OutputFolder = None
    """Output folder."""
    list: Flag = False
    """Only list the sets' objects, the shapes and the materials."""
    cache: CacheFolder = None
    """Cache of elastic modes, which take most of the time."""
    kind: Name = None
    """Shape; --list names them."""
    mesh: Annotated[Path | None, arg("MESH"), Existing("a mesh: obj, ply, glb or stl", ("a mesh or Gaussians",))] = None
    """A mesh or scan instead of a shape, in meters."""
    material: Name = None
    """Material; --list names them."""
    seed: Int = None
    """Seed of proportions, contacts, noise and imperfections."""
    impacts: Int = None
    """Number of impacts; by default 40."""
    seconds: Number = None
    """Length of each recording from its onset, by default 2 s."""
    sample_rate: Int = None
    """Sample rate, Hz; by default 48000."""
    thickness: Number = None
    """Wall, meters; by default random, of a mesh solid."""
    size: Number = None
    """Longest side of the bounding box, meters."""
    views: Int = None
    """Images, a multiple of 3, by default 72; 0 for none."""

    usual = ObjectRecipe()

    def applied(self, recipe: ObjectRecipe) -> ObjectRecipe:
        """Return a recipe with the settings and options that are given; of a set's object what it is stays."""
        names = (*_IDENTITY, "impacts", "seconds", "sample_rate", "thickness", "size", "views")
        made = with_settings(recipe, self.set, self.config, {name: getattr(self, name) for name in names})
        return replace(made, **{name: getattr(recipe, name) for name in _IDENTITY}) if self.what in SETS else made

    @cached_property
    def all_settings(self) -> ObjectRecipe:
        """The recipe of a single object: the named one, or for a set and an object of the user's own the usual one."""
        if self.what is None or self.what in SETS:
            return self.applied(ObjectRecipe())
        return self.applied(EXAMPLE if self.what == "example" else named_recipe(self.what))

    def _check(self) -> None:
        if self.output is None and not self.list:
            raise SimulationError.expected("a folder", name="output", advice="--list names the objects")
        _ = self.all_settings
        named = {each.partition("=")[0].strip() for each in self.set}
        for name in _IDENTITY if self.what in SETS else ():
            if getattr(self, name) is not None or name in named:
                advice = "leave it out"
                raise SimulationError.expected(f"none with {self.what}", got="one", name=name, advice=advice)


def run(options: Options) -> int:
    """Simulate, or list what can be simulated."""
    from avmsf.simulate.simulation_folder import simulate_set

    if options.list:
        return _list()
    assert options.output is not None
    if options.what in SETS:
        recipes, folder = {name: options.applied(each) for name, each in SETS[options.what].items()}, options.output
    else:
        place = options.output.resolve()
        recipes, folder = {place.name: options.all_settings}, place.parent
    written = simulate_set(recipes, folder, cache=options.cache, progress=display.objects())
    what = "" if len(recipes) == 1 else f"{counted(len(written), 'object')} to "
    text = f"wrote {what}{options.output}"
    if not written:
        text = f"{options.output}: simulated before with these settings; nothing was written"
    values = {"output": str(options.output), "objects": [str(folder / name) for name in recipes]}
    return finish(text, values, command("avmsf check", folder / next(iter(recipes))))


def _list() -> int:
    from avmsf.simulate.shapes import KINDS

    rows = [
        (title, name, recipe.kind, recipe.material, str(recipe.seed), "no" if name in NON_SYMMETRIC else "yes")
        for title, objects in SETS.items()
        for name, recipe in objects.items()
    ]
    columns = ("set", "object", "shape", "material", "seed", "rotational symmetry")
    listed = f"shapes for --kind: {', '.join(KINDS)}\nmaterials: {', '.join(MATERIALS)}"
    values = {"objects": [row[1] for row in rows], "shapes": list(KINDS), "materials": list(MATERIALS)}
    return finish(f"{table('objects', columns, rows, words=4)}\n{listed}", values)
