"""A small object, simulated once."""

from pathlib import Path

import pytest

from avmsf.simulate.recipe import ObjectRecipe
from avmsf.simulate.simulation import Simulation, simulate_object
from factories.made_sheet import tile


@pytest.fixture(scope="session")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> ObjectRecipe:
    """Return a coarse tile of a few hundred tetrahedra, briefly recorded."""
    mesh = tile(tmp_path_factory.mktemp("mesh") / "tile.ply")
    return ObjectRecipe(
        mesh=mesh, thickness=0.006, detail=0.15, elastic_modes=12, impacts=12, seconds=0.4, sample_rate=32000, views=3,
        view_size=48,
    )  # fmt: skip


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def simulation(recipe: ObjectRecipe, cache: Path) -> Simulation:
    return simulate_object(recipe, cache=cache)
