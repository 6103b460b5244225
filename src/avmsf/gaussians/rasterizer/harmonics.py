"""Real spherical harmonics to degree 3 and their slopes, in the order and with the signs of 3D Gaussian Splatting.

Each of the 16 functions is a polynomial in the coordinates of a unit direction (Sloan 2008, "Stupid Spherical
Harmonics Tricks", with the Condon-Shortley sign on odd orders). A color is one half more than their weighted sum.
"""

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float64

from avmsf._utils.compiled import compiled

_C0 = 0.28209479177387814
"""sqrt(1 / 4 pi); the further constants normalize their polynomials to one over the sphere likewise."""
_C1 = 0.4886025119029199
_C2, _C2_ZONAL, _C2_SECTORAL = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
_C3, _C3_PRODUCT, _C3_FLAT = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
_C3_ZONAL, _C3_TESSERAL = 0.3731763325901154, 1.445305721320277


@compiled()
@no_type_check
def _harmonics(x: float, y: float, z: float, count: int, basis: Float64[np.ndarray, "16"]) -> None:
    """Write the first `count` harmonics, 1, 4, 9 or 16, of a unit direction into `basis`."""
    basis[0] = _C0
    if count > 1:
        basis[1], basis[2], basis[3] = -_C1 * y, _C1 * z, -_C1 * x
    if count > 4:
        basis[4], basis[5], basis[7] = _C2 * x * y, -_C2 * y * z, -_C2 * x * z
        basis[6] = _C2_ZONAL * (2.0 * z * z - x * x - y * y)
        basis[8] = _C2_SECTORAL * (x * x - y * y)
    if count > 9:
        flat = 4.0 * z * z - x * x - y * y
        basis[9] = -_C3 * y * (3.0 * x * x - y * y)
        basis[10] = _C3_PRODUCT * x * y * z
        basis[11] = -_C3_FLAT * y * flat
        basis[12] = _C3_ZONAL * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        basis[13] = -_C3_FLAT * x * flat
        basis[14] = _C3_TESSERAL * z * (x * x - y * y)
        basis[15] = -_C3 * x * (x * x - 3.0 * y * y)


@compiled()
@no_type_check
def _slope(x: float, y: float, z: float, count: int, weights: Float64[np.ndarray, "16"]) -> tuple[float, float, float]:
    """Return the derivatives by x, y and z of the weighted sum of the first `count` harmonics' polynomials."""
    by_x, by_y, by_z = 0.0, 0.0, 0.0
    if count > 1:
        by_x, by_y, by_z = -_C1 * weights[3], -_C1 * weights[1], _C1 * weights[2]
    if count > 4:
        product, leaning, aside = _C2 * weights[4], -_C2 * weights[5], -_C2 * weights[7]
        zonal, sectoral = 2.0 * _C2_ZONAL * weights[6], 2.0 * _C2_SECTORAL * weights[8]
        by_x += product * y + aside * z + (sectoral - zonal) * x
        by_y += product * x + leaning * z - (sectoral + zonal) * y
        by_z += leaning * y + aside * x + 2.0 * zonal * z
    if count > 9:
        # Each group in the order of the polynomials above.
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        first, last = -_C3 * weights[9], -_C3 * weights[15]
        product, tesseral = _C3_PRODUCT * weights[10], _C3_TESSERAL * weights[14]
        along, across = -_C3_FLAT * weights[11], -_C3_FLAT * weights[13]
        zonal = _C3_ZONAL * weights[12]
        by_x += 6.0 * first * xy + product * yz - 2.0 * along * xy - 6.0 * zonal * xz
        by_x += across * (4.0 * zz - 3.0 * xx - yy) + 2.0 * tesseral * xz + 3.0 * last * (xx - yy)
        by_y += 3.0 * first * (xx - yy) + product * xz + along * (4.0 * zz - xx - 3.0 * yy) - 6.0 * zonal * yz
        by_y += -2.0 * across * xy - 2.0 * tesseral * yz - 6.0 * last * xy
        by_z += product * xy + 8.0 * along * yz + zonal * (6.0 * zz - 3.0 * xx - 3.0 * yy)
        by_z += 8.0 * across * xz + tesseral * (xx - yy)
    return by_x, by_y, by_z


@compiled()
@no_type_check
def _direction(center, position):
    """Return the unit direction from the camera to a point, and their distance."""
    x, y, z = float(center[0]) - position[0], float(center[1]) - position[1], float(center[2]) - position[2]
    distance = math.sqrt(x * x + y * y + z * z)
    return x / distance, y / distance, z / distance, distance


@compiled(error_model="numpy")
@no_type_check
def shade(lane, lanes, centers, weights, radii, position, scratch, colors):
    """Write the colors [points, 3] in which a camera at `position` sees Gaussians, all but those with radius zero.

    `scratch` [lanes, 35] are float64 numbers to work with.
    """
    points, count, basis = len(centers), weights.shape[1], scratch[lane]
    for i in range(lane * points // lanes, (lane + 1) * points // lanes):
        if radii[i, 0] > 0.0:
            x, y, z, _ = _direction(centers[i], position)
            _harmonics(x, y, z, count, basis)
            for j in range(3):
                color = 0.5
                for k in range(count):
                    color += basis[k] * float(weights[i, k, j])
                colors[i, j] = color if color > 0.0 else 0.0


@compiled(error_model="numpy")
@no_type_check
def shade_back(lane, lanes, centers, weights, radii, position, by_colors, scratch, by_centers, by_weights):
    """Add to `by_centers` [points, 3] what the colors' derivatives bring, and write those by the weights.

    Gaussians with radius zero are left out. `scratch` is that of `shade`.
    """
    points, count = len(centers), weights.shape[1]
    basis, mixed, by_color = scratch[lane, :16], scratch[lane, 16:32], scratch[lane, 32:]
    for i in range(lane * points // lanes, (lane + 1) * points // lanes):
        if not radii[i, 0] > 0.0:
            continue
        x, y, z, distance = _direction(centers[i], position)
        _harmonics(x, y, z, count, basis)
        for j in range(3):
            color = 0.5
            for k in range(count):
                color += basis[k] * float(weights[i, k, j])
            # Where a color is held at zero nothing moves it.
            by_color[j] = float(by_colors[i, j]) if color > 0.0 else 0.0
        for k in range(count):
            mixed[k] = 0.0
            for j in range(3):
                by_weights[i, k, j] = basis[k] * by_color[j]
                mixed[k] += float(weights[i, k, j]) * by_color[j]
        by_x, by_y, by_z = _slope(x, y, z, count, mixed)
        along = by_x * x + by_y * y + by_z * z
        by_centers[i, 0] += (by_x - along * x) / distance
        by_centers[i, 1] += (by_y - along * y) / distance
        by_centers[i, 2] += (by_z - along * z) / distance
