"""Blows from the other side: a mode's gain changes its sign with the direction of the blow, and nothing else."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist
from torch import Tensor

_OPPOSED = -0.5
"""Cosine between two neighbours' directions below which one of them comes from the other side: 120 degrees and more."""


def orientation_signs(
    contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None
) -> Float[Tensor, " contacts"]:
    """Return +1 or -1 a contact, such that directions times these vary as little as they can from contact to contact.

    A linear object answers a blow of direction -n with minus the answer to n, so two blows on the two sides of a thin
    wall have opposite gains at one place. A field that knows places alone can be fitted to the gains times these
    signs. Along the shortest tree that connects the contacts, a direction opposed to its neighbour's turns the sign.
    Most contacts keep +1. All ones where `directions` is None.
    """
    count = len(contacts)
    if directions is None or count < 2:
        return torch.ones(count)
    places = contacts.detach().double().cpu().numpy()
    # Contacts in one place are at distance zero, which the sparse graph would take for no edge.
    distances = cdist(places, places) + 1e-9
    tree = minimum_spanning_tree(distances)
    order, parents = breadth_first_order(tree, 0, directed=False)
    cosines = (directions.double() @ directions.double().T).cpu().numpy()
    signs = np.ones(count)
    for row in order[1:]:
        signs[row] = signs[parents[row]] * (-1.0 if cosines[row, parents[row]] < _OPPOSED else 1.0)
    if signs.sum() < 0:
        signs = -signs
    return torch.from_numpy(signs).float()
