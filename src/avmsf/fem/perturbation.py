"""How a body's stiffness and mass change, to first order, where its material departs from the nominal one.

The departures are smooth: Young's modulus and the density are multiplied by 1 + sum_l theta_l b_l(x), where b_l are the
leading eigenfunctions of the covariance exp(-r^2 / (2 L^2)) over the body (Karhunen and Loeve; Ghanem and Spanos,
Stochastic Finite Elements, 1991), scaled so that the squares of all sum to one everywhere. Variation of a wall's
thickness changes both and is covered by the two. On the basis of mode shapes Phi, of unit modal mass,

    A_l = Phi' K[b_l] Phi,   T_l = Phi' M[b_l] Phi,   N = Phi' dK/dnu Phi,

with K[b] and M[b] the stiffness and mass matrices in which b takes the place of the factor 1, and nu Poisson's ratio.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avmsf.fem.elements import REFERENCE_MASS, SecondOrder, shape_gradients
from avmsf.fem.material import Material

FIELDS = 24
"""Smooth functions for the stiffness, and as many for the density."""
_LENGTH = 0.25
"""Correlation length L of a departure, over the body's size."""
_SAMPLES = 600
"""Cells on which the eigenfunctions are solved for; the others follow by Nystroem's formula."""
_CHUNK = 256
"""Cells at a time."""


@dataclass(frozen=True, eq=False)
class Perturbations:
    """First-order changes of the modal stiffness and mass matrices."""

    stiffness: Float64[np.ndarray, "fields modes modes"]
    """A_l, 1/s2."""
    mass: Float64[np.ndarray, "fields modes modes"]
    """T_l, without unit."""
    poisson: Float64[np.ndarray, "modes modes"]
    """N, 1/s2."""


def perturbations(mesh: SecondOrder, shapes: Float64[np.ndarray, "nodes 3 modes"], material: Material) -> Perturbations:
    """Return the changes on the basis of some mode shapes, 1 / sqrt(kg)."""
    fields, slopes, volumes = smooth_fields(mesh), shape_gradients(mesh), mesh.solid.volumes.numpy()
    modes, young, poisson = shapes.shape[2], material.young, material.poisson
    shear, squeeze = young / (2.0 * (1.0 + poisson)), young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    shear_slope = -young / (2.0 * (1.0 + poisson) ** 2)
    squeeze_slope = young * (1.0 + 2.0 * poisson**2) / ((1.0 + poisson) * (1.0 - 2.0 * poisson)) ** 2
    stiff, heavy = np.zeros((len(fields), modes, modes)), np.zeros((len(fields), modes, modes))
    turned = np.zeros((modes, modes))
    root = np.linalg.cholesky(REFERENCE_MASS)
    for first in range(0, len(mesh.cells), _CHUNK):
        part = slice(first, first + _CHUNK)
        moved = shapes[mesh.cells[part]]
        weight = volumes[part] / slopes.shape[1]
        distortion, dilation = _strains(slopes[part], moved, np.sqrt(weight))
        both = np.concatenate([np.sqrt(2.0 * shear) * distortion, np.sqrt(squeeze) * dilation[:, :, None]], axis=2)
        flat = both.reshape(len(weight), -1, modes)
        moving = np.einsum("ab,cadm->cbdm", root, moved).reshape(len(weight), 30, modes)
        moving *= np.sqrt(material.density * volumes[part])[:, None, None]
        stiff += _products(flat, fields[:, part])
        heavy += _products(moving, fields[:, part])
        everywhere = np.ones((1, len(weight)))
        turned += 2.0 * shear_slope * _products(distortion.reshape(len(weight), -1, modes), everywhere)[0]
        turned += squeeze_slope * _products(dilation, everywhere)[0]
    return Perturbations(stiff, heavy, turned)


def smooth_fields(mesh: SecondOrder) -> Float64[np.ndarray, "fields cells"]:
    """Return the leading eigenfunctions of the covariance, at cells, whose squares sum to one in each cell."""
    centers, volumes = mesh.nodes[mesh.cells[:, :4]].mean(axis=1), mesh.solid.volumes.numpy()
    length, count = _LENGTH * mesh.solid.size, min(_SAMPLES, len(centers))
    some = np.sort(np.random.default_rng(0).choice(len(centers), count, replace=False, p=volumes / volumes.sum()))
    covariance = _covariance(centers[some], centers[some], length)
    values, vectors = np.linalg.eigh(covariance)
    kept = slice(max(0, count - FIELDS), count)
    # Nystroem: at other places the eigenfunction is its average over the samples, weighted by the covariance.
    found = (_covariance(centers, centers[some], length) @ (vectors[:, kept] / values[kept] ** 0.5)).T[::-1]
    return found / np.sqrt(np.square(found).sum(0))


def _covariance(one: np.ndarray, other: np.ndarray, length: float) -> np.ndarray:
    squares = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2.0 * one @ other.T
    return np.exp(-0.5 * np.maximum(squares, 0.0) / length**2)


def _strains(slopes: np.ndarray, moved: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return six strains [cells, points, 6, modes], shears times the square root of two, and their trace."""
    gradient = np.einsum("cpai,cajm->cpijm", slopes, moved) * weight[:, None, None, None, None]
    normal = [gradient[:, :, axis, axis] for axis in range(3)]
    shears = [(gradient[:, :, i, j] + gradient[:, :, j, i]) / np.sqrt(2.0) for i, j in ((0, 1), (1, 2), (0, 2))]
    return np.stack([*normal, *shears], axis=2), sum(normal)


def _products(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sums over cells of values [fields, cells] times the products [modes, modes] of a cell's rows."""
    cells, _, modes = rows.shape
    # One product for each cell serves all fields.
    products = rows.transpose(0, 2, 1) @ rows
    return (values @ products.reshape(cells, -1)).reshape(len(values), modes, modes)
