"""The sound field of an object: its gain models, their fit, the posterior of their gains, and the field's file.

In go `Impacts`, points of the object with features, and the modes of an `Extraction`; out comes a `SoundField`, the
product of gains [contacts, modes] and damped sines [modes, samples], plus residual noise. `fit` solves for the gains
with an estimator, then refines them with frequencies and dampings by the spectra of all recordings (`training`,
`losses`). Start at `fit` and `gains.mixture`; the notation is that of Rasmussen and Williams, Gaussian Processes for
Machine Learning, 2006 (R&W).

Each part of a mode's complex gains y at the n contacts is a draw of a Gaussian process (R&W 2.2), and a *hypothesis* is
a kernel K with a noise share q, the scale s^2 integrated out:

    y ~ N(0, s^2 C), C = K + (q + floor) I;  log p(y | K, q) = -n/2 log(y' C^-1 y) - 1/2 log|C|   (evidence, R&W 5.4.1)

- **Kernels** (`gains.kernels`, `symmetry`, `elastic`; R&W 4.2): white and constant, squared exponential, thin plate
  (Wahba, 1990), those projected on a symmetry's characters, in visual features, and mixtures of the mode shapes of
  bodies computed by finite elements. Each is multiplied by the cosine between the impacts' directions.
- **Weights of hypotheses** (`gains.mixture`, `fitting`): the posterior w ~ pi_h p(y | K_h, q), with the prior pi of
  kernel categories learned from all modes by expectation maximization (MacKay, 1992). None is selected.
- **Posterior** (`SoundField.posterior`): at a new contact with covariances k, the mixture over h of means k' C^-1 y and
  variances Q/n (k0 - k' C^-1 k), Q = y' C^-1 y (R&W 2.25, 2.26, with s^2 by its posterior);
  leave-one-place-out errors follow in closed form (R&W 5.4.2) and give `quality`, outliers and `next_contacts`.

Types: `SoundField` (`sound_field`); `GainModel` with `AttentionGains` (the paper's network), `MixtureGains`,
`BodyGains` (a guess without recordings) and `ScaledGains` (edits); `FitConfig` (`config`). `store` has the file.
`next_contacts`: where to strike next, of the places that can be struck; `probable_body`: the body of most evidence.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
