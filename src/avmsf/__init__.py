"""The sound of real objects: from a few taps to a field that sounds right wherever the object is struck."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from avmsf.bench.evaluation import evaluate, split
    from avmsf.capture import Capture, CaptureSettings, Impacts, Surface, check, read_capture, write_capture
    from avmsf.field.config import PAPER, FitConfig
    from avmsf.field.fit import fit
    from avmsf.field.soundfield import SoundField
    from avmsf.field.store import load, save
    from avmsf.modal.bank import ModalBank
    from avmsf.modal.extract import HighResolution, ShortTime, extract
    from avmsf.modal.extraction import Extraction
    from avmsf.modal.residual import Residual
    from avmsf.scene.features import FeatureField

__version__ = "0.1.0"

__all__ = [
    "PAPER",
    "Capture",
    "CaptureSettings",
    "Extraction",
    "FeatureField",
    "FitConfig",
    "HighResolution",
    "Impacts",
    "ModalBank",
    "Residual",
    "ShortTime",
    "SoundField",
    "Surface",
    "check",
    "evaluate",
    "extract",
    "fit",
    "load",
    "read_capture",
    "save",
    "split",
    "write_capture",
]

# Names are fetched when they are first asked for: torch takes seconds to import, and `avmsf --help` needs none of it.
_HOMES = {
    "avmsf.bench.evaluation": ("evaluate", "split"),
    "avmsf.capture": ("Capture", "CaptureSettings", "Impacts", "Surface", "check", "read_capture", "write_capture"),
    "avmsf.field.config": ("PAPER", "FitConfig"),
    "avmsf.field.fit": ("fit",),
    "avmsf.field.soundfield": ("SoundField",),
    "avmsf.field.store": ("load", "save"),
    "avmsf.modal.bank": ("ModalBank",),
    "avmsf.modal.extract": ("HighResolution", "ShortTime", "extract"),
    "avmsf.modal.extraction": ("Extraction",),
    "avmsf.modal.residual": ("Residual",),
    "avmsf.scene.features": ("FeatureField",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'avmsf' has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
