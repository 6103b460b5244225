"""The modes that recordings of one object share, with the recordings' common time zero.

In go `Impacts`; out comes an `Extraction`: a `ModalBank`, each recording's complex gains, and the residual noise.

1. `alignment`: the common time zero, by one delay a recording (`phase_likelihood`) and where the mean power leaves the
   noise. `Alignment.apply` aligns recordings that were held out.
2. `finders`: frequencies and dampings, by one of two methods. `HighResolution`: matrix pencils (ESPRIT) in subbands
   (`esprit`), forward selection by orthogonal least squares (`Selection`) and variable projection
   (`least_squares.refine`). `ShortTime`: the paper's regression in each bin of a short-time spectrum (`stft`).
3. `least_squares.fit_gains`: the complex gains of these modes in each recording, whichever method found them; at poles
   of each recording's own where frequencies shift between recordings (`frequency_shifts`).

`quality` judges how well the recordings support each mode, `alignment_report` what is wrong with recordings. Start
reading at `extract.extract_modes`.

A new method is a subclass of `finders.ModeFinder`, its entry in `extract.FINDERS` and its name in
`avmsf.modal.config.ExtractionMethod`: commands, settings, evaluations and files take it from there.
"""
