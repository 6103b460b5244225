"""Sound fields for other tools: web page, glTF, Faust, sample sets, UFF, the paper's demo layout."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
