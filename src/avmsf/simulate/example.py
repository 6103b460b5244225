"""The built-in example: a ceramic mug, struck and photographed by this package's own simulator."""

from pathlib import Path
from typing import TYPE_CHECKING

from avmsf.simulate.recipe import ObjectRecipe

if TYPE_CHECKING:
    from avmsf.mesh.textured_mesh import TexturedMesh

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


def example_mesh() -> "TexturedMesh":
    """Return the mesh, in its colors, that the example's recordings and photographs were computed from."""
    from avmsf.simulate.shapes import make_shape, textured

    return textured(make_shape(EXAMPLE.kind, seed=EXAMPLE.seed, size=EXAMPLE.size, wall=EXAMPLE.thickness))
