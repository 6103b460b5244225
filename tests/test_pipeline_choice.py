"""Gain models are chosen by their errors on training contacts, and a model that cannot be used is reported."""

import pytest
import torch

from avmsf.errors import FitError, SimulationError
from avmsf.field.recipes import ThinPlate
from avmsf.pipeline.choice import all_recipes, recipe_for
from avmsf.scene.features import FeatureField


def candidates() -> dict[str, FeatureField]:
    return {"true": FeatureField.from_points(torch.rand(20, 3, generator=torch.Generator().manual_seed(0)))}


def no_physics():
    raise SimulationError("no body can be made of this surface")


def test_physics_that_cannot_be_had_is_told_and_left_out() -> None:
    heard: list[str] = []
    recipes = all_recipes(no_physics, tell=heard.append)
    assert [each.name for each in recipes.candidates] == ["spline"]
    assert recipes.unavailable == {"physics": "no body can be made of this surface"}
    assert heard == ["no physics: no body can be made of this surface"]


def test_a_recipe_is_found_by_its_name() -> None:
    assert isinstance(recipe_for("spline", {}, no_physics), ThinPlate)
    assert recipe_for("true", candidates(), no_physics).name == "true"
    with pytest.raises(FitError, match="gains from visual need what the folder does not have; there are true"):
        recipe_for("visual", candidates(), no_physics)
    with pytest.raises(SimulationError, match="no body"):
        recipe_for("physics", candidates(), no_physics)
