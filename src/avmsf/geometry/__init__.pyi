from .outer import DepthMap as DepthMap
from .outer import object_surface as object_surface
from .shape import Cavity as Cavity
from .shape import ObjectShape as ObjectShape
from .shape import ShapeReport as ShapeReport
