"""Published recordings of many objects, each read as the `Capture` that a folder made by hand would give."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
