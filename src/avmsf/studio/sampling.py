"""The table of an edited field without new predictions: edits do not change the ratios of gains between contacts."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.export.sampled_field import SampledField, supporting_columns
from avmsf.field.scaled_gains import fitted_gains, length_of
from avmsf.field.sound_field import SoundField
from avmsf.field.uncertainty import scale_of


def sample(field: SoundField, points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"]) -> SampledField:
    """Return the table of a field at points of the object that it was fitted to, meters."""
    sampled = SampledField.of(field, points.double() * length_of(field.gain_field), normals)
    return replace(sampled, points=points)


def resample(sampled: SampledField, before: SoundField, after: SoundField) -> SampledField | None:
    """Return the table of the field `after` an edit from that of the field `before`.

    None if that is not possible: for another fitted field, another phase, or a mode that was inaudible or muted.
    """
    if fitted_gains(before.gain_field) is not fitted_gains(after.gain_field) or not torch.equal(
        before.phase, after.phase
    ):
        return None
    old, new = scale_of(before), scale_of(after)
    if bool((after.audible & (~before.audible | ((old == 0) & (new != 0)))).any()):
        return None
    heard = torch.nonzero(after.audible).flatten()
    columns = (torch.cumsum(before.audible.long(), 0) - 1)[heard]
    factor = torch.where(old[heard] == 0, 0.0, new[heard] / old[heard])
    change = after.bank.damping[heard] / before.bank.damping[heard]
    return replace(
        sampled,
        frequency=after.bank.frequency[heard],
        damping=sampled.damping[..., columns] * change,
        sine=(sampled.sine[:, columns] * factor).float(),
        cosine=(sampled.cosine[:, columns] * factor).float(),
        supporting=supporting_columns(after),
    )
