"""Appearance and shape of an object: 3D Gaussians, image features in 3D, and symmetries."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
