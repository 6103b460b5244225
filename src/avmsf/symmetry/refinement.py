"""Moving a candidate's plane or axis to where the cloud fits itself best."""

import numpy as np

from avmsf.symmetry.alignment import Halves
from avmsf.symmetry.motions import Motion


def fit_motion(
    motion: Motion,
    halves: Halves,
    *,
    angles: tuple[float, ...] = (),
    queries: int = 600,
    steps: int = 14,
    width: float = 0.05,
) -> Motion:
    """Return the motion with its plane or axis where moved points lie nearest to the surface.

    Gauss-Newton on the distances along the target's normals: turning the plane or axis by w about the origin and
    shifting it by v moves the image q = L p + t of p by w x q + v - L (w x p + v). Turns are fitted at all `angles`
    together, their own by default. Distances are weighted down (Geman and McClure) beyond a width that shrinks from
    `width` to half a spacing, so that holes and one-sided parts lose their pull.
    """
    points = halves.queries[:queries]
    turns = [motion.angle] if motion.angle is None or not angles else list(angles)
    least = 0.5 * halves.spacing
    scales: list[float] = np.geomspace(max(width, least), least, steps).tolist()
    for scale in scales:
        left, right = np.zeros((6, 6)), np.zeros(6)
        for angle in turns:
            moved_by = Motion(motion.direction, motion.point, angle)
            linear, moved = moved_by.linear, moved_by.apply(points)
            reach, row = halves.tree.query(moved, distance_upper_bound=3 * scale + 3 * halves.spacing)
            met = np.isfinite(reach)
            image, source, near = moved[met], points[met], row[met]
            normal = halves.target.normals[near]
            residual = np.einsum("ni,ni->n", image - halves.target.points[near], normal)
            back = normal @ linear
            slopes = np.c_[np.cross(image, normal) - np.cross(source, back), normal - back]
            weights = (scale**2 / (scale**2 + reach[met] ** 2)) ** 2
            left += slopes.T @ (weights[:, None] * slopes)
            right -= slopes.T @ (weights * residual)
        # Turning a plane within itself or an axis about itself changes nothing: those directions stay unmoved.
        values, vectors = np.linalg.eigh(left)
        kept = values > 1e-4 * values[-1]
        step = vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
        length = float(np.linalg.norm(step))
        step *= min(1.0, 0.15 / max(length, 1e-12))
        motion = motion.shifted(step[:3], step[3:])
    return motion
