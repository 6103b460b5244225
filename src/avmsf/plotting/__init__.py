"""Figures of sounds, modes, gains and surfaces, with matplotlib.

In go plain values of the other packages: tensors of sounds and points, `ModalBank`, `ContactPosterior`, `Surface`.
Out comes a matplotlib `Figure`, never a window, which `save_picture` writes as png, pdf or svg. Every
figure has one style (`style.styled`), with colors that color-blind people tell apart.

- `pictures`: modes as stems of level and decay time (T60); gains of modes over the object; short-time spectra of
  recordings and renderings, with logarithmic frequency.
- `objects`: an object from several sides, with features, symmetries and cuts.
- `uncertainty`: the posterior of a contact; the standard deviation of gains.
- `edits`: modes before and after an edit, and the CLAP score over its steps.

Start reading at `style`, then `objects`, whose views the pictures share.
"""
