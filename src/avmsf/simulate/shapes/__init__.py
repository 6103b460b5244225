"""Objects by rule (`catalog`), every seed another, of prisms (`body`): `revolution`, `sheet`, `sweep`, `freeform`."""

from avmsf.simulate.shapes.catalog import KINDS, Shape, make_shape, textured

__all__ = ["KINDS", "Shape", "make_shape", "textured"]
