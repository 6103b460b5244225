"""From recordings of impacts, in files or made by a simulation, to sounds that can be fitted together.

In goes a folder: `impacts.csv` (a recording and its contact in each row), the sound files, perhaps `capture.toml`
(`CaptureSettings`) and a surface. Out comes a `Capture`, whose `Impacts` hold one sound for each contact, of one rate
and length, from the impact on and per newton where forces are known; or a `CaptureReport` of what is wrong. Datasets
and the simulator enter one step later, with pairs of an `Impact` and its `Recording`. Every step tells `Issues`, which
raise the first error for `read_capture` and collect all for `check`.

Onsets are found here in each recording alone, to a few samples. The recordings come to one time zero later, by the
phases of their modes (`avmsf.modal.extraction.alignment`); for it `Impacts.before` and `after` keep 20 ms on either
side of each sound.

`settings`, `table`, `audio` -> `prepare` (`onset`, highpass, force) -> `preprocess` -> `Impacts`;
`filenames`, `table`, surface -> `checks` (`placement`) -> `issues`, what is wrong.

- `prepare`: an onset by the first sample above a tenth of the peak and the noise, or by the hammer's pulse; division by
  the peak force, or deconvolution by the pulse (Tikhonov-regularized); a zero-phase Butterworth highpass.
- `preprocess`: the one way from recordings to impacts. Impulse responses, which start with the impact, are recognized
  over all recordings and not cut.
- `measure`: level, noise, clipping and second impacts (spectral rise in all excited bins) of one recording.
- `placement`: whether contacts lie on a surface; else the similarity (unit, axes, scale, shift) that brings them onto
  it, by iterated closest points (Besl and McKay, 1992) and description length (Rissanen, 1978).
- `proposals`: units, channels and a highpass that the files themselves suggest.

Start with `folder.read_capture`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
