"""Modes: damped sines that all recordings of an object share, their extraction from recordings, and their synthesis.

A `ModalBank` holds frequencies f (Hz) and dampings d (1/s) [modes]. With the complex gains c [contacts, modes] the
sound of an impact is the sum over modes of Im(c exp((-d + 2 pi i f) t)), plus noise of one spectrum (`Residual`).

- `extraction`: from recordings to their common time zero, modes, gains and residual (`extract_modes`). Start here.
- `modes`: the bank, the phase that all contacts have in common, the cosine distance of gains at any delay, the pulse of
  a hammer's force, and from gains and modes to sounds, with gradients.
- `residual_noise`: the noise beside the modes, its estimate and its synthesis.
- `spectra`: short-time and mel spectra, one convention for losses, metrics and pictures; sounds at a common rate,
  length and level.
- `inner_products`: closed forms of damped sines' inner products over time.
- `config`: the names of methods in settings, and sizes of transforms at any sample rate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
