"""Modes: damped sinusoids that all recordings of an object share, their extraction and their synthesis."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
