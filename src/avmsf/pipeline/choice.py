"""Which way of spreading gains suits an object: what there is to choose from, and the choice as a stage keeps it."""

from collections.abc import Callable, Mapping
from typing import Literal

from avmsf.errors import AvmsfError, FitError
from avmsf.field.automatic import Automatic
from avmsf.field.physics import Physics
from avmsf.field.recipes import Attention, GainRecipe, ThinPlate
from avmsf.scene.features import FeatureField

Spreading = Literal["auto", "physics", "spline", "visual", "positions"]
"""How gains are spread over an object: by its elastic mode shapes, by splines, by the paper's network on what places
look like or on where they are; auto takes elastic mode shapes or splines, whichever predicts training contacts better
that are left out in turn."""


def recipe_for(name: str, candidates: Mapping[str, FeatureField], physics: Callable[[], Physics]) -> GainRecipe:
    """Return the recipe of this name, on the candidates' features. Raises FitError where there are no such features.

    `physics` makes the recipe that knows the object's shape, and raises AvmsfError where the shape does not serve.
    """
    if name == "physics":
        return physics()
    if name == "spline":
        return ThinPlate()
    if name not in candidates:
        raise FitError(f"gains from {name} need what the folder does not have; there are {', '.join(candidates)}")
    return Attention(candidates[name], name)


def all_recipes(physics: Callable[[], Physics], *, tell: Callable[[str], None] | None = None) -> Automatic:
    """Return all ways to choose from; where physics cannot be had, the choice's report says why.

    The network is not among them: it would have to be trained once for each contact that is left out.
    """
    recipes: list[GainRecipe] = []
    missing: dict[str, str] = {}
    try:
        recipes.append(physics())
    except AvmsfError as error:
        missing["physics"] = str(error)
        if tell is not None:
            tell(f"no physics: {error}")
    return Automatic((*recipes, ThinPlate()), missing)
