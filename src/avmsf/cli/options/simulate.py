"""Options of `avmsf simulate`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from avmsf.cli.options.common import Flag, Printing, parse_options
from avmsf.cli.options.paths import CacheFolder, InputError, OutputFolder
from avmsf.errors import SimulationError
from avmsf.simulate.recipe import EXAMPLE, SET, ObjectRecipe, sim20_recipe


@dataclass(frozen=True)
class Options(Printing):
    """Simulate objects, their recordings and images, as capture folders with ground truth.

    `avmsf simulate sim-20 --output FOLDER` makes the benchmark set, one folder per object. It skips complete objects,
    so repeat an interrupted command to continue it. A single object, of the set by its name or any other by --kind or
    --mesh, is written to FOLDER itself.
    """

    what: tyro.conf.Positional[Annotated[str | None, tyro.conf.arg(metavar="NAME")]] = None
    """sim-20 for the benchmark set, the name of one of its objects, or example for the object of `avmsf demo`; nothing
    for an object of your own."""
    output: OutputFolder = None
    """Output folder."""
    list: Flag = False
    """Only list the set's objects, the shapes and the materials."""
    cache: CacheFolder = None
    """Cache of elastic modes, which take most of the time: other hammers, noises and views are then fast."""
    recipe: Annotated[ObjectRecipe, tyro.conf.arg(name="")] = field(default_factory=ObjectRecipe)
    """The object, its impacts, recordings and images; for an object of the set, what differs from it."""

    def check_inputs(self) -> None:
        """Raise `InputError` also for a mesh that does not exist, `SimulationError` for options that do not fit."""
        super().check_inputs()
        if self.output is None and not self.list:
            raise SimulationError("--output: expected a folder, got none; --list names the objects", name="output")
        for name in ("kind", "mesh", "material", "seed") if self.what == SET else ():
            value = getattr(self.recipe, name)
            if value != getattr(ObjectRecipe(), name):
                raise SimulationError(
                    f"--{name}: expected none with {SET}, got {value}; leave it out", name=name, value=str(value)
                )
        if (mesh := self.recipe.mesh) is not None and not mesh.is_file():
            raise InputError.expected(
                "a mesh: obj, ply, glb or stl", got="no such file or folder", file=mesh, advice="check the name"
            )

    @classmethod
    def parse(cls, words: Sequence[str]) -> "Options":
        """Return the options that the words spell."""
        options = parse_options(cls, "simulate", words, default=cls())
        # A second time from the named object's recipe: what is asked for may be a default, and not that object's.
        recipe = None if options.list else _recipe_of(options.what)
        return options if recipe is None else parse_options(cls, "simulate", words, default=cls(recipe=recipe))


def _recipe_of(what: str | None) -> ObjectRecipe | None:
    """Return the named object's recipe; None for the whole set and for an object of the user's own."""
    if what in (None, SET):
        return None
    return EXAMPLE if what == "example" else sim20_recipe(what)
