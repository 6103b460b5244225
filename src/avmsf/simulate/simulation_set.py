"""Many simulated objects in one folder, one folder each: made one after the other, kept where they are whole."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from avmsf.errors import SimulationError
from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.simulation import simulate_object
from avmsf.simulate.simulation_folder import is_written, write_simulation


@dataclass(frozen=True)
class SetProgress:
    """How far a set of objects is."""

    name: str
    """The object at hand."""
    done: int
    """Objects that are whole."""
    total: int
    stage: str
    """What is being computed; `exists` for an object that was complete before, `done` for one that is complete now."""


def simulate_set(
    recipes: Mapping[str, ObjectRecipe],
    folder: str | Path,
    *,
    cache: Path | None = None,
    progress: Callable[[SetProgress], None] | None = None,
) -> None:
    """Simulate the objects that the folder does not hold yet, each into a folder of its name.

    An interrupted run goes on with the first object that is not whole. Raises SimulationError, before anything is made,
    where the folder of an object holds something else or an object of another recipe.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise SimulationError(f"{folder}: expected a folder, got a file; choose another name", file=folder)
    log = progress or (lambda _: None)
    whole = {name: is_written(recipe, folder / name) for name, recipe in recipes.items()}
    for done, (name, recipe) in enumerate(recipes.items()):

        def stage(words: str, name: str = name, done: int = done) -> None:
            log(SetProgress(name, done, len(recipes), words))

        if not whole[name]:
            simulation = simulate_object(recipe, name=name, cache=cache, progress=stage)
            stage(f"{recipe.views} views" if recipe.views else "files")
            write_simulation(simulation, folder / name)
        log(SetProgress(name, done + 1, len(recipes), "exists" if whole[name] else "done"))
