"""Objects made by rule, every seed another individual: triangles with colors, tetrahedra and known symmetries."""

from avmsf.simulate.shapes.body import Symmetry
from avmsf.simulate.shapes.catalog import KINDS, Shape, make_shape, textured

__all__ = ["KINDS", "Shape", "Symmetry", "make_shape", "textured"]
