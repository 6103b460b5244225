"""Photographs with cameras: read from folders, undistorted, with masks of the object on a plain background."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
