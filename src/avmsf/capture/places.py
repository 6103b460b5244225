"""Which contacts are at one place."""

import numpy as np
import scipy
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

SAME_PLACE = 0.01
"""Distance between contacts over the diagonal of the box around all, up to which they are one place: hammers do not hit
more exactly."""


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
