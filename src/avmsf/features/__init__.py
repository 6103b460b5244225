"""Features of images on the surface of an object: computed, lifted, reduced and pooled over symmetries."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
