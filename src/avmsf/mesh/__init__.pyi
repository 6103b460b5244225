from .surface import Surface as Surface
