"""Recordings with contacts: the folder that a user fills by hand, read, checked, prepared and written."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
