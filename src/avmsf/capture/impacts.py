"""The recordings of one object, with their contact positions."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_directions, as_forces, as_rate, as_vectors
from avmsf._utils.caching import content_digest
from avmsf.errors import ArrayError

SAME_PLACE = 0.01
"""Distance between contacts over the diagonal of the box around all, up to which they are one place: hammers do not hit
more exactly."""
_SINC_HALF_WIDTH = 32
"""Samples on either side that a value between two samples is interpolated from."""
_WHOLE_SAMPLE = 1e-3
"""Samples below which a fraction is not worth interpolating: it turns a mode at half the rate by .003 rad."""


@dataclass(frozen=True, eq=False)
class Impacts:
    """Impacts on one object, one row each, all at one sample rate and of one length."""

    contacts: Float[Tensor, "contacts 3"]
    """Contact points in the object frame, meters; read in float64, so that equal distances stay equal."""
    sounds: Float[Tensor, "contacts samples"]
    """Response to each impact, starting at its onset; per newton where the forces are known, else as recorded."""
    sample_rate: float
    """Samples per second of `sounds`, Hz."""
    names: tuple[str, ...]
    """What each recording is called, for messages and tables: its file's path in the capture folder."""
    directions: Float[Tensor, "contacts 3"] | None = None
    """Unit vectors along which the hammer moved, where they are known."""
    forces: Float[Tensor, " contacts"] | None = None
    """Peak force of each impact that `sounds` was divided by, newtons, where it is known."""
    before: Float[Tensor, "contacts lead"] | None = None
    """What each file holds just before `sounds`, in the same unit; NaN where it holds nothing. None where the sounds
    are final: aligned with one another already (`avmsf.modal.extraction.alignment`), or given without their files."""
    after: Float[Tensor, "contacts tail"] | None = None
    """What each file holds just after `sounds`, likewise; None together with `before`."""

    def __post_init__(self) -> None:
        if (self.before is None) != (self.after is None):
            name = "before" if self.before is None else "after"
            raise ArrayError(f"{name}: expected both before and after, or neither, got only one", name=name)

    @classmethod
    def of(
        cls,
        contacts: ArrayLike,
        sounds: ArrayLike,
        sample_rate: float | int,
        *,
        names: Sequence[str] | None = None,
        directions: ArrayLike | None = None,
        forces: ArrayLike | None = None,
    ) -> "Impacts":
        """Return final impacts of contacts in meters and of sounds that start with them, one row each.

        Recordings without `names` are numbered. `forces` are those that the sounds were divided by. Raises ArrayError
        for arrays of other shapes, values that are not finite, no row at all, and a sample rate that is not above 0.
        """
        places = as_vectors(contacts, "contacts").double()
        count = len(places)
        if not count:
            raise ArrayError("contacts: expected one or more, got 0", name="contacts", value=0)
        named = tuple(f"{row:03d}" for row in range(1, count + 1)) if names is None else tuple(map(str, names))
        if len(named) != count:
            raise ArrayError.expected(f"{count}, one for each contact", len(named), name="names")
        return cls(
            places,
            as_vectors(sounds, "sounds", count=count, size=None).float(),
            as_rate(sample_rate),
            named,
            None if directions is None else as_directions(directions, "directions", count=count).float(),
            None if forces is None else as_forces(forces, "forces", count=count, positive=True).float(),
        )

    @property
    def duration(self) -> float:
        """Length of every sound, seconds."""
        return self.sounds.shape[1] / self.sample_rate

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        places = len(rows_by_place(self.contacts))
        return (
            f"Impacts({len(self)} recordings at {places} positions, {self.duration:.3g} s at {self.sample_rate:g} Hz)"
        )

    def digest(self) -> str:
        """Return a digest of the recordings and of their names, contacts, directions and forces."""
        known = (self.contacts, self.sounds, self.directions, self.forces, self.before, self.after)
        return content_digest(self.names, self.sample_rate, *known)

    def take(self, rows: ArrayLike) -> "Impacts":
        """Return the given rows alone, in the given order; of a mask, one truth value each, those that are true.

        Raises ArrayError for a mask of another length, and for fractions.
        """
        index = torch.from_numpy(np.array(list(rows)))
        if index.dtype == torch.bool:
            if len(index) != len(self):
                raise ArrayError.expected(f"{len(self)} truth values", len(index), name="rows")
            index = index.nonzero().flatten()
        elif not bool((index == index.long()).all()):
            raise ArrayError.expected("whole numbers", index.tolist(), name="rows")
        index = index.long()
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        taken: dict[str, Any] = {name: value[index] for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, names=tuple(self.names[row] for row in index.tolist()), **taken)

    def delayed(self, delays: Float64[Tensor, " contacts"]) -> "Impacts":
        """Return the recordings cut again, each starting `delays` samples later in its file (earlier where negative).

        Between samples by a windowed sinc. What a file does not hold is zero. The result is final: its `before` and
        `after` are None. Raises ArrayError for delays that are not finite.
        """
        if not bool(torch.isfinite(delays).all()):
            row = int((~torch.isfinite(delays)).nonzero()[0])
            wanted = "finite numbers of samples"
            raise ArrayError.expected(wanted, float(delays[row]), row=row, name="delays")
        margins = [self.sounds.new_zeros(len(self), 0) if each is None else each for each in (self.before, self.after)]
        whole = torch.cat([margins[0], self.sounds, margins[1]], dim=1).nan_to_num_(nan=0.0)
        sounds = _cut(whole, margins[0].shape[1] + delays, self.sounds.shape[1])
        return replace(self, sounds=sounds, before=None, after=None)


def places_of(contacts: Float64[Tensor, "contacts 3"]) -> Int[Tensor, " contacts"]:
    """Return the number of each contact's place, from 0 on; no two of one are farther apart than `SAME_PLACE`."""
    places, owner = torch.unique(contacts, dim=0, return_inverse=True)
    distance = SAME_PLACE * float((places.amax(0) - places.amin(0)).norm())
    near = np.unique(scipy.spatial.cKDTree(places.numpy()).query_pairs(distance, output_type="ndarray"))
    if not len(near):
        return owner
    # Complete linkage: along a row of contacts each near to the next, places would else grow without end.
    tree = scipy.cluster.hierarchy.linkage(places[near].numpy(), "complete")
    groups = scipy.cluster.hierarchy.fcluster(tree, distance, criterion="distance")
    first = np.arange(len(places))
    first[near] = near[np.unique(groups, return_index=True)[1][groups - 1]]
    return torch.unique(torch.from_numpy(first), return_inverse=True)[1][owner]


def rows_by_place(contacts: Float[Tensor, "contacts 3"]) -> tuple[tuple[int, ...], ...]:
    """Return the rows of each place by `places_of`, ascending; places are in the order of their first rows."""
    found: dict[int, list[int]] = {}
    for row, place in enumerate(places_of(contacts.double()).tolist() if len(contacts) else ()):
        found.setdefault(place, []).append(row)
    return tuple(tuple(rows) for rows in found.values())


def _cut(
    signals: Float[Tensor, "contacts frames"], starts: Float64[Tensor, " contacts"], samples: int
) -> Float[Tensor, "contacts samples"]:
    """Return `samples` samples of each signal from its start on, which may lie between samples or outside."""
    whole = starts.round()
    offset = (starts - whole)[:, None]
    taps = torch.arange(-_SINC_HALF_WIDTH, _SINC_HALF_WIDTH + 1, dtype=torch.float64)
    distance = taps - offset
    # A Kaiser window of this shape leaves ripples of about -80 dB (Oppenheim and Schafer, eq. 7.75).
    shape = 8.0 * (1 - (distance / (_SINC_HALF_WIDTH + 1)).square()).clamp(min=0).sqrt()
    between = torch.sinc(distance) * torch.special.i0(shape) / float(np.i0(8.0))
    kernels = torch.where(offset.abs() < _WHOLE_SAMPLE, (taps == 0).double(), between)
    sounds = signals.new_empty(len(signals), samples)
    frames = np.arange(-_SINC_HALF_WIDTH, samples + _SINC_HALF_WIDTH)
    for row, first in enumerate(whole.long().tolist()):
        held = (first + frames >= 0) & (first + frames < signals.shape[1])
        padded = np.zeros(len(frames))
        padded[held] = signals[row].numpy()[first + frames[held]]
        sounds[row] = torch.from_numpy(np.correlate(padded, kernels[row].numpy(), "valid"))
    return sounds
