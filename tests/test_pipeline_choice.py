"""How gains are spread is chosen by what foretells training contacts, and what cannot be had is told."""

from dataclasses import replace

import pytest
import torch

from avmsf.errors import FitError, SimulationError
from avmsf.field.config import FitConfig
from avmsf.field.fit import gain_case
from avmsf.field.recipes import Attention, ThinPlate
from avmsf.modal.extract import HighResolution, extract
from avmsf.pipeline.choice import all_recipes, recipe_for
from avmsf.scene.features import FeatureField
from avmsf.simulate.plate import plate_surface_points, sample_contacts, strike
from plate_capture import CONTACT_TIME, HIGHEST, PLATE, RATE

CONFIG = FitConfig(clusters=8, width=16, hidden=64, layers=2, warmup_steps=150, steps=0, fft_sizes=(1024, 256))


def blows(count: int):
    generator = torch.Generator().manual_seed(3)
    contacts = sample_contacts(PLATE, count, generator=generator)
    options = {"sample_rate": RATE, "seconds": 0.5, "noise_db": -40.0, "highest": HIGHEST}
    return strike(PLATE, contacts, generator=generator, contact_time=CONTACT_TIME, **options)


def candidates() -> dict[str, FeatureField]:
    """Places in random order beside true ones: what is near in these features is anywhere on the plate."""
    true = FeatureField.from_points(plate_surface_points(PLATE, 2000))
    shuffled = true.features[torch.randperm(len(true.points), generator=torch.Generator().manual_seed(0))]
    return {"shuffled": replace(true, features=20 * shuffled), "true": true}


def no_physics():
    raise SimulationError("no body can be made of this surface")


def test_features_that_tell_where_a_place_is_win_over_the_same_ones_shuffled() -> None:
    train = blows(12)
    recipes = all_recipes(candidates(), no_physics)
    networks = tuple(each for each in recipes.candidates if isinstance(each, Attention))
    case = gain_case(train, candidates()["true"], extract(train, HighResolution(modes=10)), CONFIG)
    choice = replace(recipes, candidates=networks).choose(case)
    assert choice.recipe.name == "true"
    errors = choice.report["choice"]["errors"]
    assert errors["true"] < 0.9 * errors["shuffled"]


def test_physics_that_cannot_be_had_is_told_and_left_out() -> None:
    heard: list[str] = []
    recipes = all_recipes(candidates(), no_physics, tell=heard.append)
    assert [each.name for each in recipes.candidates] == ["spline", "shuffled", "true"]
    assert recipes.unavailable == {"physics": "no body can be made of this surface"}
    assert heard == ["no physics: no body can be made of this surface"]


def test_a_recipe_is_found_by_its_name() -> None:
    assert isinstance(recipe_for("spline", {}, no_physics), ThinPlate)
    assert recipe_for("true", candidates(), no_physics).name == "true"
    with pytest.raises(FitError, match="gains from visual need what the folder does not have; there are shuffled"):
        recipe_for("visual", candidates(), no_physics)
    with pytest.raises(SimulationError, match="no body"):
        recipe_for("physics", candidates(), no_physics)
