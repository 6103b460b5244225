"""The built-in example: a ceramic mug, struck and photographed by this package's own simulator."""

from pathlib import Path

from avmsf.simulate.recipe import ObjectRecipe

EXAMPLE = ObjectRecipe(
    kind="mug",
    thickness=0.003,
    seed=1,
    impacts=16,
    sample_rate=44100,
    seconds=1.0,
    noise_db=-40.0,
    views=48,
    view_size=192,
    surface=False,
)
"""`avmsf simulate example` makes it anew; `--surface` adds the mesh."""
EXAMPLE_FOLDER = Path(__file__).parents[1] / "example"
"""The capture folder that the package ships, made of that recipe: recordings and photographs, no mesh."""
