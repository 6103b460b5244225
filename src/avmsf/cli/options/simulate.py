"""Options of `avmsf simulate`."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import Configured, Flag
from avmsf.cli.options.paths import CacheFolder, Existing, OutputFolder
from avmsf.cli.options.settings import with_settings
from avmsf.errors import SimulationError
from avmsf.simulate.recipe import EXAMPLE, SETS, ObjectRecipe, named_recipe


@dataclass(frozen=True)
class Options(Configured):
    """Simulate objects, their recordings and images, as capture folders with ground truth.

    `avmsf simulate sim-20 --output FOLDER` makes a benchmark set, one folder per object. It skips complete objects, so
    repeat an interrupted command to continue it. A single object, of the set by its name or any other by --kind or
    --mesh, is written to FOLDER itself.
    """

    what: tyro.conf.Positional[Annotated[str | None, tyro.conf.arg(metavar="NAME")]] = None
    """sim-20 or held-out for a benchmark set, the name of one of its objects, or example for the object of `avmsf
    demo`; nothing for an object of your own."""
    output: OutputFolder = None
    """Output folder."""
    list: Flag = False
    """Only list the sets' objects, the shapes and the materials."""
    cache: CacheFolder = None
    """Cache of elastic modes, which take most of the time: other hammers, noises and views are then fast."""
    kind: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Shape; --list names them."""
    mesh: Annotated[
        Path | None, tyro.conf.arg(metavar="MESH"), Existing("a mesh: obj, ply, glb or stl", ("a mesh or Gaussians",))
    ] = None
    """A mesh or scan instead of a shape, in meters."""
    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Name in the table of materials; --list names them."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Random seed of the shape's proportions, the contacts, the noise and the imperfections."""
    impacts: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Number of impacts; by default 40."""
    seconds: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Length of each recording that is used, from its onset, by default 2 s. The files are longer."""
    sample_rate: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Sample rate, Hz; by default 48000."""
    thickness: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Wall thickness, meters. By default that of a shape is drawn at random, and a mesh is a solid body; with a
    thickness the mesh is the outside of a wall."""
    size: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Longest side of the bounding box, meters; by default that of the random shape or of the mesh."""
    views: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Images to render, on three circles around the object: a multiple of 3, by default 72; 0 for none."""

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


_IDENTITY = ("kind", "mesh", "material", "seed")
"""What distinguishes the objects of the set."""


def _recipe_of(what: str | None) -> ObjectRecipe:
    """Return the named object's recipe; for the whole set and for an object of the user's own the usual one."""
    if what is None or what in SETS:
        return ObjectRecipe()
    return EXAMPLE if what == "example" else named_recipe(what)
