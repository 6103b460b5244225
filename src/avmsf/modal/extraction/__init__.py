"""The modes that recordings of one object share, with the recordings' common time zero.

In go `Impacts`; out comes an `Extraction`: a `ModalBank`, each recording's complex gains, and the residual noise.

1. `alignment`: the common time zero. The onset that `avmsf.capture.prepare` found in each recording alone is off by a
   few samples. Here each recording gets one delay, so that every mode has one phase (modulo pi) in all of them, by
   maximum a posteriori with von Mises phases (`phase_likelihood`); then the start common to all is set where their mean
   power leaves the noise. `Impacts.delayed` cuts the recordings anew, between samples by a windowed sinc.
   `Alignment.apply` aligns recordings that were held out; `alignment_report` says what was done.
2. `finders`: frequencies and dampings, by one of two methods. `HighResolution`: matrix pencils (ESPRIT) in subbands
   (`esprit`), forward selection by orthogonal least squares (`selection`) and variable projection
   (`least_squares.refine`). `ShortTime`: the paper's regression in each bin of a short-time spectrum (`stft`).
3. `least_squares.fit_gains`: the complex gains of these modes in each recording, whichever method found them; at poles
   of each recording's own where frequencies shift between recordings (`frequency_shifts`).

`quality` judges how well the recordings support each mode, `alignment_report` what is wrong with recordings. Start
reading at `extract.extract_modes`.

A new method is a subclass of `finders.ModeFinder`, its entry in `extract.FINDERS` and its name in
`avmsf.modal.config.ExtractionMethod`: commands, settings, evaluations and files take it from there.
"""
