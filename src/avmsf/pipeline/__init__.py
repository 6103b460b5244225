"""Stages from a capture folder to a sound field, each kept in a folder and made again only where something changed.

In goes a `Capture` (recordings, contacts, and a mesh, photographs, a video or Gaussians) and one `PipelineConfig`; out
comes a `SoundField`. Start reading at `fit.fit`, which `avmsf.fit` and `avmsf fit` call.

- `stages`: a `Stage` is a name, the stages that it depends on and a function; a `Pipeline` makes them when they are
  asked for, a `StageFolder` (`CAPTURE/.avmsf`) keeps each output next to the record of what it was made from.
- `views`, `scene`: from what shows the object to views with cameras and masks (structure from motion, rendering), to
  Gaussians, and to features on the surface (`features`: lifted, reduced, pooled over symmetries).
- `shape`: the object's points, symmetries and surface, from its mesh or from views. `visual_checks`: whether contacts,
  mesh, masks and Gaussians are of one object in one frame, and what `avmsf check` says of them.
- `bodies`: the finite-element models that a surface may enclose, and the field of one of a known material without
  recordings. `fit`: modes and gains.
- `config`: settings of all stages, and the presets `default` and `paper`.

Raises AvmsfError, by its kind: CaptureError, SceneError, SimulationError, ExtractionError, FitError, FolderInUseError.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
