"""The sound of real objects: from a few recordings of impacts to their sound anywhere on the object.

    capture = avmsf.read("bowl")
    train, test = avmsf.split(capture, train_size=0.75)
    field = avmsf.fit(train)
    print(avmsf.evaluate(field, test).mean())
    sounds = field.render([[0.05, 0.02, 0.043]])

All other names are in the sub-packages, as `avmsf.field.FitConfig`.
"""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from pathlib import Path

    from avmsf.capture import Capture, CaptureSettings

__version__ = "0.9.0"

# Imported when first used: torch takes seconds. The stub `__init__.pyi` lists the names, also for editors.
__getattr__, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["read"]


def __dir__() -> list[str]:
    return __all__


def read(folder: "str | Path", settings: "CaptureSettings | None" = None) -> "Capture":
    """Read a capture folder: recordings, contacts, and a mesh where it has one.

    Args:
        folder: Folder with `impacts.csv` and the sound files that it names.
        settings: Take the place of the folder's `capture.toml`.

    Returns:
        Contacts [contacts, 3] in meters, sounds [contacts, samples] from their onsets on, and the surface.

    Raises:
        CaptureError: For what cannot be used. What is probably wrong is a CaptureWarning (see
            `avmsf.capture.read_capture`).
    """
    from avmsf.capture.folder import read_capture

    return read_capture(folder, settings)
