"""The mesh of the built-in example."""

from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.simulate.example import EXAMPLE
from avmsf.simulate.shapes import make_shape, textured


def example_mesh() -> TexturedMesh:
    """Return the mesh, in its colors, that the example's recordings and photographs were computed from."""
    shape = make_shape(EXAMPLE.kind, seed=EXAMPLE.seed, size=EXAMPLE.size, wall=EXAMPLE.thickness)
    return textured(shape)
