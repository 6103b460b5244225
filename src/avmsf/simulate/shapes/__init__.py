"""Objects made by rule, every seed another individual: triangles with colors, tetrahedra and known symmetries.

`catalog` has all kinds; they are made of prisms (`body`): `revolution`, `sheet`, `sweep` and `freeform` (lumps).
"""

from avmsf.simulate.shapes.body import Symmetry
from avmsf.simulate.shapes.catalog import KINDS, Shape, make_shape, textured

__all__ = ["KINDS", "Shape", "Symmetry", "make_shape", "textured"]
