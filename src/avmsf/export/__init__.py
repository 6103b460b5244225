"""Sound fields for other tools.

In goes a `SoundField`, or its table at points of the surface; out come files that other programs read, and notes on
what their format cannot represent (`Written`). All formats start from a `SampledField`: frequencies, dampings, and a
sine and a cosine amplitude of each mode at each point, of which `SampledField.render` is the reference that every file
is compared with.

- `web.write_webpage`, `web.make_bundle`: the studio's page with one field, as a folder or a single file.
- `gltf.write_gltf`: the object (`geometry`) and its modes in the draft extension KHR_audio_rigid_bodies.
- `faust.write_faust`: a bank of resonators as a Faust program.
- `samples.write_grid`: wav files of chosen contacts and forces, with a table and an SFZ instrument.
- `uff.write_universal`: nodes, mode shapes and frequency response functions in the universal file format (UFF).
- `paper_demo.write_demo`: the layout of the paper's web demo.

A new format is a writer here, a name in `writing.Format`, entries in `writing.FORMATS` and `write.WRITERS`, and in
`avmsf.cli.export` the options that it uses (`_USED`, `Options`), what to do with its files (`_NEXT`) and `_for_format`.

`write.write` (`avmsf.write`) chooses the writer by a file's ending. Files and folders are written atomically, and
replaced only with `overwrite=True`. Start reading at `sampled_field`, which has real amplitudes for formats of one
phase too, then any writer.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
