"""The sound field of an object: its gain models, its fit, its file, and the uncertainty of its gains."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
