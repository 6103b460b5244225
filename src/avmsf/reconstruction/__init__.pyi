from .object_shape import ObjectShape as ObjectShape
from .object_shape import ShapeReport as ShapeReport
from .outer_surface import object_surface as object_surface
