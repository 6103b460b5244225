"""Symmetries of a shape: rotations and reflections, and the groups that they form."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
