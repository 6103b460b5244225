"""3D Gaussians: their files, their fit to photographs, and what they show of an object."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
