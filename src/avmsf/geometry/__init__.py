"""The shape of an object from photographs: its outer side, its cavities, and the bodies that it may be."""

from avmsf.geometry.outer import DepthMap, object_surface
from avmsf.geometry.shape import Cavity, ObjectShape, ShapeReport

__all__ = ["Cavity", "DepthMap", "ObjectShape", "ShapeReport", "object_surface"]
