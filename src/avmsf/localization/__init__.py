"""Localization of impacts: the posterior of the contact over an object's surface.

In go a `SoundField` and a recording; out comes a `ContactPosterior`: for each point of the surface the probability that
the impact was there, and the paper's cosine distance of recorded and predicted gains (section Contact Localization).

- `amplitudes`: least-squares amplitudes of known modes in a sound, with the covariance of their errors.
- `prediction`: the field's gains over the surface and their variance; leave-one-out calibration of both (conformal
  factor, exponent of the tempered likelihood).
- `likelihood`: the likelihood of the amplitudes at each point, with force and onset unknown, and the Bayes factor of an
  impact against noise.
- `locator`, `contact_map`: these in a table computed once for any number of sounds (`Locator`), and its answer with
  credible region, peaks and the symmetries that explain them.
- `preprocess`, `locate`: from a file to that answer, for one impact, or for several by linear-prediction onsets;
  recordings of other objects are rejected by a null model of detuned modes.
- `streaming`: impacts in a stream, located while they still decay (`StreamingLocalizer`).

Start reading at `locate.locate`, then `Locator.locate`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
