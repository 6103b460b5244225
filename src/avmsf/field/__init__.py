"""The sound field of an object: its gain models, their fit, the posterior of their gains, and the field's file.

In go `Impacts`, points of the object with features, and the modes of an `Extraction`; out comes a `SoundField`, the
product of gains [contacts, modes] and damped sines [modes, samples], plus residual noise. `fit` solves for the gains
with an estimator, then refines them with frequencies and dampings by the spectra of all recordings (`training`,
`losses`). Start at `fit` and at `gains`, which lists the modules of the gain models; `gains.mixture` has the
mathematics of the Gaussian process, docs/gain-models.md all formulas with their code and tests.

Types: `SoundField` (`sound_field`); `GainModel` with `AttentionGains` (the paper's network), `MixtureGains`,
`BodyGains` (a guess without recordings) and `ScaledGains` (edits); `FitConfig` (`config`). `store` has the file.
`next_contacts`: where to strike next, of the places that can be struck; `quality`: its errors by leave-one-out, and the
body of most evidence.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
