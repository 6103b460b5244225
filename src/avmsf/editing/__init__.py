"""Edits of a sound field: another material or size, other modes, or the sound of recordings or of a text.

In goes a `SoundField`; out comes another, which renders, saves, locates and can be edited again. Frequencies, dampings
and one factor on the gains of each mode change; the ratios of gains between contacts, the spatial field, stay. What was
done is the last entry of `origin.report["edits"]`.

- `material`: laws of linear modal analysis for another material and size (`change_material`), Rayleigh damping, and the
  material that is nearest to a field's dampings; `edit`, which is `avmsf.edit`.
- `modal_edit`: factors on single modes (`adjust_modes`), and `ModalEdit`, the paper's hierarchical form (section 3.6),
  differentiable.
- `guided`: `edit_towards` optimizes a `ModalEdit` with Adam towards a guide's target sounds by the multi-scale spectral
  loss.
- `reference`, `distillation`, `stable_audio`: the guides: recordings or the statistics of a material; a text, by
  decoder distillation (Audio-SDS) of Stable Audio. `config`: their settings.

Start reading at `modal_edit`, whose `edited` all edits end in, then `material`, then `guided`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
