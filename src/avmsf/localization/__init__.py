"""Localization of impacts: the posterior of the contact over an object's surface."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
