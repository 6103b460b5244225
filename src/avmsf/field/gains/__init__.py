"""Gains over the surface of an object, from those of recorded impacts; R&W is Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2006.

- `model`, `data`: what every gain model is, and what it is fitted to.
- `kernels`, `symmetry`, `elastic`: covariance functions, in families of one assumption each (R&W 4).
- `mixture`: regression, evidence, the average over kernels and leave-one-out predictions (R&W 2, 5). Start here.
- `fitting`: measured gains, the prior of kernels learned from all modes, and which shape of a body a mode is.
- `mixture_gains`, `attention`, `scaled`: the final classes, and their form in a file.
- `outliers`: log predictive ratios, by which labels are wrong and whether a body is credible.
- `regression`: the model of some contacts and bodies, with what gains say of supports and of changed stiffness.
- `estimator`: the order of all this in a fit, and the gains at the contacts, refined end to end on spectra.

All gains are [contacts, modes] in the unit of the sounds. Signs are as measured, for the impacts' own directions,
unless said otherwise. p is the phase of each mode, `GainData.phase`.

- `Extraction.gains`: complex c; the sound is Im(c exp((-d + 2 pi i f) t)). Read by `modal` and `data`.
- `GainData.values`, `MeasuredGains.values`: complex c exp(-i p). Read by `regression`, `fitting`, `outliers`.
- `GainData.gains`: real, amplitudes of sines of phase p times `orientation_signs`, or of spectra without a sign. Read
  by `attention` and `training`.
- `SoundField.gains`: real part of what is predicted of c exp(-i p). Read by users and published localization.
- `SoundField.complex_gains`: complex A = -i c; the sound is Re(A exp((-d + 2 pi i f) t)). Read by `evaluation`.

A new family of kernels of the position is a subclass of `kernels.KernelFamily` in `kernels.POSITIONAL`: fits, reports
and files take it from there.
"""
