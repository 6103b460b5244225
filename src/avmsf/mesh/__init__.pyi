from .surface import Surface as Surface
from .surface import read_surface as read_surface
from .surface import write_surface as write_surface
