"""The sound of real objects: from a few recordings of impacts to their sound anywhere on the object.

    capture = avmsf.Capture.read("bowl")
    train, test = capture.split(train_size=0.75)
    field = avmsf.SoundField.fit(train)
    print(avmsf.evaluate(field, test).mean())
    sounds = field.render([[0.05, 0.02, 0.043]])

All other names are in the sub-packages, as `avmsf.field.FitConfig`.
"""

import lazy_loader

__version__ = "0.1.0"

# Imported when first used: torch takes seconds. The stub `__init__.pyi` lists the names, also for editors.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
