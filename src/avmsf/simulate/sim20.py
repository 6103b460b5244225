"""The benchmark set `sim-20`: twenty shapes and materials, everything else by the recipe's defaults."""

from avmsf.errors import SimulationError
from avmsf.simulate.recipe import ObjectRecipe

SET = "sim-20"
_OBJECTS = (
    "mug-ceramic", "bowl-glass", "skillet-iron", "plate-ceramic", "spoon-steel", "goblet-glass", "bracket-steel",
    "bell-iron", "blob-polycarbonate", "pot-steel", "dish-ceramic", "fluted-ceramic", "jug-glass", "tray-polycarbonate",
    "mug-plastic", "tube-steel", "spoon-wood", "platter-wood", "jug-ceramic", "bowl-wood",
)  # fmt: skip
"""Kinds and materials; an object's place here, counted from 1, is its seed."""
_WALLS = {
    "mug-ceramic": 0.003,
    "skillet-iron": 0.0025,
    "bell-iron": 0.002,
    "tube-steel": 0.0015,
    "jug-ceramic": 0.003,
    "tray-polycarbonate": 0.006,
}
_SIZES = {"blob-polycarbonate": 0.5, "tube-steel": 0.5}
"""Walls and longest sides that differ from what is drawn, meters: where few modes would be heard, or most too low."""
SIM20 = {
    name: ObjectRecipe(kind=kind, material=material, seed=seed, size=_SIZES.get(name), thickness=_WALLS.get(name))
    for seed, name in enumerate(_OBJECTS, start=1)
    for kind, material in (name.split("-"),)
}
"""Recipes by the objects' names, in the order in which they are made."""
NON_SYMMETRIC = tuple(
    name
    for name, recipe in SIM20.items()
    if recipe.kind in ("mug", "skillet", "spoon", "bracket", "blob", "dish", "jug")
)
"""Objects whose shape no turn carries onto itself; of mug, skillet and spoon a mirror does."""

ABLATED = ("mug-ceramic", "bowl-glass", "bracket-steel", "pot-steel", "dish-ceramic", "spoon-wood")
"""Objects of the smaller studies: with and without symmetry, ringing and dull, thick and thin."""


def sim20_recipe(name: str) -> ObjectRecipe:
    """Return the recipe of one of the set's objects. Raises SimulationError with the names there are."""
    if name not in SIM20:
        raise SimulationError(
            f"expected an object of {SET} ({', '.join(SIM20)}), got {name!r}; check the name", name=SET, value=name
        )
    return SIM20[name]
