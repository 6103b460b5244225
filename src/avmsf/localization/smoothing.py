"""Smoothing of the posterior over the surface: a field of few contacts has errors of position.

What such a field predicts at a position is often true of one nearby, in all modes at once. The deviations of single
modes do not contain that. So the posterior is smoothed by a part of the distance between the contacts.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.field.gains.model import MixtureGains
from avmsf.field.scaled_gains import fitted_gains
from avmsf.field.sound_field import SoundField

POSITION_STD_PER_SPACING = 0.06
"""Standard deviation of a place over the distance between contacts, along each direction: measured on plates."""
_MAX_POSITION_STD = 0.03
"""The same over the object's diagonal, at most."""
_KERNEL_CUTOFF = 2.5
"""Standard deviations at which the kernel ends."""
_NEIGHBORS = 6


def distinct_contacts(field: SoundField) -> int | None:
    """Return how many contacts in different places a field was fitted to; None where that is not known."""
    gains = fitted_gains(field.gain_field)
    if isinstance(gains, MixtureGains):
        return gains.place_count
    return len(field.origin.trained_on) or None


def point_areas(points: Float[Tensor, "points 3"]) -> Float64[Tensor, " points"]:
    """Return the area of surface that falls to each of at least two points, square meters, by its neighbors."""
    places = points.double().numpy()
    count = min(_NEIGHBORS, len(places) - 1)
    distances, _ = cKDTree(places).query(places, k=count + 1)
    return torch.from_numpy(np.pi * distances[:, -1] ** 2 / (count + 0.5))


def smoothing_matrix(points: Float[Tensor, "points 3"], *, contacts: int | None) -> csr_array | None:
    """Return the kernel that smooths probabilities over neighboring points (meters); its columns sum to one.

    None for a field of unknown contacts, and for points that are all at one place.
    """
    if contacts is None or len(points) < 2:
        return None
    areas = point_areas(points)
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    off = min(POSITION_STD_PER_SPACING * math.sqrt(float(areas.sum()) / contacts), _MAX_POSITION_STD * diagonal)
    # A place may be anywhere in the square that a point stands for, before it is moved and after.
    deviation = math.sqrt(off**2 + float(areas.median()) / 6.0)
    if off <= 0.0:
        return None
    places = points.double().numpy()
    near = cKDTree(places).query_pairs(_KERNEL_CUTOFF * deviation, output_type="ndarray")
    weights = np.exp(-0.5 * ((places[near[:, 0]] - places[near[:, 1]]) ** 2).sum(1) / deviation**2)
    own = np.arange(len(places))
    rows, columns = np.concatenate([near[:, 0], near[:, 1], own]), np.concatenate([near[:, 1], near[:, 0], own])
    kernel = coo_array((np.concatenate([weights, weights, np.ones(len(own))]), (rows, columns))).tocsr()
    return (kernel / np.asarray(kernel.sum(axis=0))).tocsr()
