"""The shape of an object from photographs: its outer side, its cavities, and the bodies that it may be."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
