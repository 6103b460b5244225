"""Objects made by rule, every seed another individual: triangles with colors, tetrahedra and known symmetries."""

from avmsf.simulate.shapes.kinds import KINDS, make_shape
from avmsf.simulate.shapes.shape import Shape, Symmetry, textured
from avmsf.simulate.shapes.variation import vary_thickness

__all__ = ["KINDS", "Shape", "Symmetry", "make_shape", "textured", "vary_thickness"]
