"""Stages from a capture folder to a sound field."""

import lazy_loader

from avmsf.config import PRESETS, BodyConfig, PipelineConfig

__getattr__, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = ["PRESETS", "BodyConfig", "PipelineConfig", *_names]


def __dir__() -> list[str]:
    return __all__
