"""The ellipse that a Gaussian becomes in an image.

Its covariance R S S R^T becomes J W R S S R^T W^T J^T + 0.3 I, W the camera's rotation and J the Jacobian of the
perspective projection at its center (Zwicker et al. 2002, "EWA Splatting"; 3DGS adds the 0.3 square pixels, so that
nothing falls between the pixels). Computed in float64, since the determinants of long thin ellipses cancel; the results
are float32.

All that a kernel calls, and every constant it holds, stands in its own file: numba keeps what it compiled until that
file changes, and looks at no other.
"""

import math
from typing import no_type_check

import numpy as np

from avmsf._utils.compiled import compiled

MIN_DEPTH_M = 0.01
"""Gaussians with centers nearer than this to the camera's plane are not seen, meters (gsplat's default)."""
_MAX_VARIANCE = 1e30
"""Ellipses with larger variances, square pixels, are dropped: float32 cannot hold what follows from them."""
MIN_ALPHA = 1.0 / 255.0
"""A Gaussian counts at a pixel where it covers at least this much (3DGS)."""
_BLUR = 0.3
"""What is added to the variances in the image, square pixels (3DGS)."""


@compiled()
@no_type_check
def _rotate(rotation, turn):
    """Write the matrix of a quaternion w, x, y, z into `turn`; return the quaternion's length."""
    w, x, y, z = float(rotation[0]), float(rotation[1]), float(rotation[2]), float(rotation[3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if length > 0.0:
        w, x, y, z = w / length, x / length, y / length, z / length
    turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return length


@compiled()
@no_type_check
def _rotate_back(rotation, length, by, result):
    """Write the derivatives by a quaternion of length `length` into `result`, given those by its matrix, `by`."""
    w, x, y, z = rotation[0] / length, rotation[1] / length, rotation[2] / length, rotation[3] / length
    by_w = 2 * (x * (by[2, 1] - by[1, 2]) + y * (by[0, 2] - by[2, 0]) + z * (by[1, 0] - by[0, 1]))
    by_x = 2 * (y * (by[0, 1] + by[1, 0]) + z * (by[0, 2] + by[2, 0]) + w * (by[2, 1] - by[1, 2]))
    by_y = 2 * (x * (by[0, 1] + by[1, 0]) + z * (by[1, 2] + by[2, 1]) + w * (by[0, 2] - by[2, 0]))
    by_z = 2 * (x * (by[0, 2] + by[2, 0]) + y * (by[1, 2] + by[2, 1]) + w * (by[1, 0] - by[0, 1]))
    by_x -= 4 * x * (by[1, 1] + by[2, 2])
    by_y -= 4 * y * (by[0, 0] + by[2, 2])
    by_z -= 4 * z * (by[0, 0] + by[1, 1])
    # The length of the quaternion is of no effect: the derivative along it is zero.
    along = w * by_w + x * by_x + y * by_y + z * by_z
    result[0], result[1] = (by_w - along * w) / length, (by_x - along * x) / length
    result[2], result[3] = (by_y - along * y) / length, (by_z - along * z) / length


@compiled()
@no_type_check
def _inside(center, pose):
    """Return a point of the object frame in the camera's frame."""
    x, y, z = float(center[0]), float(center[1]), float(center[2])
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@compiled()
@no_type_check
def _axes(turn, scales, pose, x, y, z, lens, jacobian, axes):
    """Write J W into `jacobian` [2, 3] and J W R S into `axes` [2, 3]; return the tangents at which J is taken."""
    across, down = min(max(x / z, lens[6]), lens[7]), min(max(y / z, lens[8]), lens[9])
    for j in range(3):
        jacobian[0, j] = lens[0] / z * (pose[0, j] - across * pose[2, j])
        jacobian[1, j] = lens[1] / z * (pose[1, j] - down * pose[2, j])
    for row in range(2):
        for j in range(3):
            dot = jacobian[row, 0] * turn[0, j] + jacobian[row, 1] * turn[1, j] + jacobian[row, 2] * turn[2, j]
            axes[row, j] = dot * scales[j]
    return across, down


@compiled()
@no_type_check
def _variances(axes):
    """Return the blurred covariance xx, xy, yy and its determinant, which is summed from squares so that it stays."""
    xx = axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2
    xy = axes[0, 0] * axes[1, 0] + axes[0, 1] * axes[1, 1] + axes[0, 2] * axes[1, 2]
    yy = axes[1, 0] ** 2 + axes[1, 1] ** 2 + axes[1, 2] ** 2
    crossed = (axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1]) ** 2
    crossed += (axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2]) ** 2
    crossed += (axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]) ** 2
    return xx + _BLUR, xy, yy + _BLUR, crossed + _BLUR * (xx + yy) + _BLUR * _BLUR


@compiled()
@no_type_check
def _usable(center, rotation, log_scale, logit, weights):
    """Return whether all of a Gaussian's numbers are finite and its quaternion has a length."""
    # A sum of finite float32 numbers in float64 is finite.
    total = float(logit)
    for j in range(3):
        total += float(center[j]) + float(log_scale[j])
    length = 0.0
    for j in range(4):
        length += abs(float(rotation[j]))
    for k in range(len(weights)):
        for j in range(3):
            total += float(weights[k, j])
    return math.isfinite(total) and 0.0 < length < math.inf


@compiled(error_model="numpy")
@no_type_check
def project_points(lane, lanes, cloud, pose, lens, scratch, results):
    """Write what `Projection.forward` returns into arrays of zeros, all but the colors, which are only checked.

    `scratch` [lanes, 16, 3] are float64 numbers to work with.
    """
    centers, rotations, log_scales, logits, harmonics = cloud
    screen, ellipses, opacities, depths, radii, remainders = results
    points = len(centers)
    turn, jacobian, axes, scales = scratch[lane, :3], scratch[lane, 3:5], scratch[lane, 5:7], scratch[lane, 7]
    for i in range(lane * points // lanes, (lane + 1) * points // lanes):
        if not _usable(centers[i], rotations[i], log_scales[i], logits[i], harmonics[i]):
            radii[i, 0] = np.nan
            continue
        x, y, z = _inside(centers[i], pose)
        opacity = 1.0 / (1.0 + math.exp(-float(logits[i])))
        if z < MIN_DEPTH_M or opacity < MIN_ALPHA:
            continue
        for j in range(3):
            scales[j] = math.exp(float(log_scales[i, j]))
        _rotate(rotations[i], turn)
        _axes(turn, scales, pose, x, y, z, lens, jacobian, axes)
        xx, xy, yy, determinant = _variances(axes)
        # Also false for what is not a number.
        if not xx + yy < _MAX_VARIANCE:
            continue
        across, down = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        reach = math.sqrt(2.0 * math.log(opacity / MIN_ALPHA))
        wide, high = reach * math.sqrt(xx), reach * math.sqrt(yy)
        if across + wide <= 0 or across - wide >= lens[4] or down + high <= 0 or down - high >= lens[5]:
            continue
        screen[i, 0], screen[i, 1] = across, down
        remainders[i, 0], remainders[i, 1] = across - float(screen[i, 0]), down - float(screen[i, 1])
        steep = math.sqrt(yy / determinant)
        ellipses[i, 0], ellipses[i, 1], ellipses[i, 2] = steep, -xy / yy * steep, 1.0 / math.sqrt(yy)
        half = 0.5 * (xx + yy)
        radii[i, 0] = reach * math.sqrt(half + math.sqrt(max(half * half - determinant, 0.0)))
        opacities[i, 0], depths[i, 0] = opacity, z


@compiled(inline="always")
@no_type_check
def _axes_back(by_ellipse, axes, by_axes):
    """Write the derivatives by J W R S into `by_axes`, given those by p = D^(-1/2), r = -p xy / yy, s = yy^(-1/2).

    D = xx - xy^2 / yy is what is left of the variance along x where y is known.
    """
    _, xy, yy, determinant = _variances(axes)
    steep, slant = math.sqrt(yy / determinant), xy / yy
    by_p, by_r, by_s = float(by_ellipse[0]), float(by_ellipse[1]), float(by_ellipse[2])
    by_xx = -0.5 * steep * steep * steep * (by_p - slant * by_r)
    by_xy = -2.0 * slant * by_xx - steep / yy * by_r
    by_yy = slant * slant * by_xx + slant * steep / yy * by_r - 0.5 * by_s / (yy * math.sqrt(yy))
    for j in range(3):
        by_axes[0, j] = 2.0 * by_xx * axes[0, j] + by_xy * axes[1, j]
        by_axes[1, j] = 2.0 * by_yy * axes[1, j] + by_xy * axes[0, j]


@compiled(inline="always")
@no_type_check
def _factors_back(by_axes, turn, scales, jacobian, axes, by_log_scale, by_turn, by_jacobian):
    """Write the derivatives by the logarithms of S, by R and by J W, given those by their product J W R S."""
    for j in range(3):
        by_log_scale[j] = by_axes[0, j] * axes[0, j] + by_axes[1, j] * axes[1, j]
        for k in range(3):
            by_turn[k, j] = (jacobian[0, k] * by_axes[0, j] + jacobian[1, k] * by_axes[1, j]) * scales[j]
    for row in range(2):
        for k in range(3):
            by_jacobian[row, k] = 0.0
            for j in range(3):
                by_jacobian[row, k] += by_axes[row, j] * turn[k, j] * scales[j]


@compiled(inline="always")
@no_type_check
def _center_back(by_place, by_depth, by_jacobian, x, y, z, across, down, pose, lens, inner):
    """Write the derivatives by a center in the camera's frame into `inner` [3].

    They come through its place in the image, and through J, whose first row is focal / z (1, 0, -x / z).
    """
    inner[0] = lens[0] / z * float(by_place[0])
    inner[1] = lens[1] / z * float(by_place[1])
    inner[2] = -(x * inner[0] + y * inner[1]) / z + float(by_depth)
    for row in range(2):
        focal = lens[row] / z
        tangent, place, clear = (across, x, across == x / z) if row == 0 else (down, y, down == y / z)
        along, ahead = 0.0, 0.0
        for k in range(3):
            along += by_jacobian[row, k] * pose[row, k]
            ahead += by_jacobian[row, k] * pose[2, k]
        inner[2] -= focal / z * (along - tangent * ahead)
        if clear:
            inner[row] -= focal / z * ahead
            inner[2] += focal / z * ahead * place / z


@compiled(error_model="numpy")
@no_type_check
def project_points_back(lane, lanes, cloud, radii, slopes, pose, lens, scratch, results):
    """Write the derivatives by centers, rotations, sizes and opacities, without what the colors add to the centers.

    `slopes` are those by places, ellipses, opacities and depths. The results come as zeros, and stay so where the
    radius is zero. `scratch` is that of `project_points`.
    """
    centers, rotations, log_scales, logits = cloud
    by_screen, by_ellipses, by_opacities, by_depths = slopes
    by_centers, by_rotations, by_log_scales, by_logits = results
    # Inlined, for views of rows that a call hands over cost more than these steps.
    points = len(centers)
    turn, jacobian, axes, scales = scratch[lane, :3], scratch[lane, 3:5], scratch[lane, 5:7], scratch[lane, 7]
    by_turn, by_jacobian, by_axes = scratch[lane, 8:11], scratch[lane, 11:13], scratch[lane, 13:15]
    inner = scratch[lane, 15]
    for i in range(lane * points // lanes, (lane + 1) * points // lanes):
        if not radii[i, 0] > 0.0:
            continue
        x, y, z = _inside(centers[i], pose)
        for j in range(3):
            scales[j] = math.exp(float(log_scales[i, j]))
        length = _rotate(rotations[i], turn)
        across, down = _axes(turn, scales, pose, x, y, z, lens, jacobian, axes)
        _axes_back(by_ellipses[i], axes, by_axes)
        _factors_back(by_axes, turn, scales, jacobian, axes, by_log_scales[i], by_turn, by_jacobian)
        _rotate_back(rotations[i], length, by_turn, by_rotations[i])
        _center_back(by_screen[i], by_depths[i, 0], by_jacobian, x, y, z, across, down, pose, lens, inner)
        opacity = 1.0 / (1.0 + math.exp(-float(logits[i])))
        by_logits[i] = float(by_opacities[i, 0]) * opacity * (1.0 - opacity)
        for j in range(3):
            by_centers[i, j] = pose[0, j] * inner[0] + pose[1, j] * inner[1] + pose[2, j] * inner[2]
