"""Smoothing of the probabilities of points, since a field's positions between its contacts are uncertain.

What a field made of few contacts says of a place is often true of one nearby, in all modes at once. No deviation of
single modes tells that. So an answer is spread by a part of the distance between the contacts.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.gains.model import MixtureGains
from avmsf.field.scaledgains import fitted_gains
from avmsf.field.soundfield import SoundField

POSITION_STD = 0.06
"""Standard deviation of a place over the distance between contacts, along each direction: measured on plates."""
_MOST = 0.03
"""The same over the object's diagonal, at most."""
_REACH = 2.5
"""Standard deviations up to which an answer is spread."""
_NEIGHBORS = 6


def contacts_of(field: SoundField) -> int | None:
    """Return how many contacts in different places a field learnt from; None where that is not known."""
    gains = fitted_gains(field.gain_field)
    if isinstance(gains, MixtureGains):
        return gains.place_count
    return len(field.origin.trained_on) or None


def areas_of(points: Float[Tensor, "points 3"]) -> Float64[Tensor, " points"]:
    """Return the area of surface that falls to each of at least two points, square meters, by its neighbors."""
    places = points.double().numpy()
    count = min(_NEIGHBORS, len(places) - 1)
    distances, _ = cKDTree(places).query(places, k=count + 1)
    return torch.from_numpy(np.pi * distances[:, -1] ** 2 / (count + 0.5))


def smoothing_kernel(points: Float[Tensor, "points 3"], *, contacts: int | None) -> csr_array | None:
    """Return what spreads probabilities of points (meters) over those about: [points, points], its columns sum to one.

    None for a field of unknown contacts, and for points that are all at one place.
    """
    if contacts is None or len(points) < 2:
        return None
    areas = areas_of(points)
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    off = min(POSITION_STD * math.sqrt(float(areas.sum()) / contacts), _MOST * diagonal)
    # A place may be anywhere in the square that a point stands for, before it is moved and after.
    deviation = math.sqrt(off**2 + float(areas.median()) / 6.0)
    if off <= 0.0:
        return None
    places = points.double().numpy()
    near = cKDTree(places).query_pairs(_REACH * deviation, output_type="ndarray")
    weights = np.exp(-0.5 * ((places[near[:, 0]] - places[near[:, 1]]) ** 2).sum(1) / deviation**2)
    own = np.arange(len(places))
    rows, columns = np.concatenate([near[:, 0], near[:, 1], own]), np.concatenate([near[:, 1], near[:, 0], own])
    kernel = coo_array((np.concatenate([weights, weights, np.ones(len(own))]), (rows, columns))).tocsr()
    return (kernel / np.asarray(kernel.sum(axis=0))).tocsr()
