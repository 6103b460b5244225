"""Where symmetries may be: principal axes, and pairs of points about which the surface is alike.

Two points with their normals say which plane would mirror one onto the other, and about which axis by which angle one
would turn into the other. Many pairs say something, most of it wrong; what they say is scored on a coarse picture of
the cloud, and the best that differ are kept.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from avmsf.gaussians.neighborhoods import Neighborhoods, describe_neighborhoods
from avmsf.symmetry.alignment import Motion, draw_by_area

_CELLS = 56
_DESCRIBED, _COUNTED, _PARTNERS = 900, 1800, 24
_SAME_DEGREES, _SAME_GAP = 9.0, 0.05

Pairs = tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]
"""Rows of the first and of the second points of pairs."""


@dataclass(frozen=True, eq=False)
class CoarseCloud:
    """Distances to a cloud on a grid, and a few points of it: quick to ask, good to a fiftieth of the object."""

    distances: Float[np.ndarray, "across along up"]
    lowest: Float[np.ndarray, " 3"]
    cell: float
    points: Float[np.ndarray, "few 3"]
    width: float

    @classmethod
    def of(cls, surface: Neighborhoods, few: Float[np.ndarray, "few 3"], *, width: float = 0.03) -> "CoarseCloud":
        """Fill the grid; `few` are the points that will be moved."""
        lowest, highest = surface.points.min(0) - 0.1, surface.points.max(0) + 0.1
        cell = float((highest - lowest).max()) / _CELLS
        shape = np.ceil((highest - lowest) / cell).astype(int) + 1
        empty = np.ones(shape, dtype=bool)
        empty[tuple(((surface.points - lowest) / cell).astype(int).T)] = False
        return cls(distance_transform_edt(empty) * cell, lowest, cell, few, width)

    def score(
        self, linear: Float[np.ndarray, "motions 3 3"], fixed: Float[np.ndarray, "motions 3"]
    ) -> Float[np.ndarray, " motions"]:
        """Return how much of the cloud each motion L, with a point that it leaves, carries onto the cloud, 0 to 1."""
        scores, offset = np.empty(len(linear)), fixed - np.einsum("mij,mj->mi", linear, fixed)
        for start in range(0, len(linear), 2000):
            part = slice(start, start + 2000)
            # Single precision is exact to a millionth of the object and takes half the time.
            turned = self.points.astype(np.float32) @ linear[part].astype(np.float32).transpose(0, 2, 1)
            moved = turned + (offset[part] - self.lowest)[:, None].astype(np.float32)
            place = (moved / np.float32(self.cell)).astype(np.int32)
            limit = np.array(self.distances.shape) - 1
            inside = ((moved >= 0) & (place <= limit)).all(axis=2)
            place = np.clip(place, 0, limit)
            distance = np.where(inside, self.distances[place[..., 0], place[..., 1], place[..., 2]], 1.0)
            scores[part] = np.exp(-((distance / self.width) ** 2)).mean(axis=1)
        return scores

    def score_motions(self, motions: list[Motion]) -> Float[np.ndarray, " motions"]:
        """Return `score` of each motion."""
        if not motions:
            return np.zeros(0)
        return self.score(np.stack([each.linear for each in motions]), np.stack([each.point for each in motions]))


def principal_motions(surface: Neighborhoods) -> list[Motion]:
    """Return reflections and half turns along the principal axes of the surface, through its means and box's middle."""
    areas = np.minimum(surface.spacing**2, 4 * np.median(surface.spacing**2))
    mean = (areas[:, None] * surface.points).sum(0) / areas.sum()
    centered = surface.points - mean
    _, axes = np.linalg.eigh((areas[:, None] * centered).T @ centered)
    along = surface.points @ axes
    box = axes @ ((along.min(0) + along.max(0)) / 2)
    return [
        Motion(axes[:, column], center, angle)
        for column in range(3)
        for center in (mean, box, np.median(along, axis=0) @ axes.T)
        for angle in (None, math.pi)
    ]


def mirrors_of_pairs(surface: Neighborhoods, pairs: Pairs, *, coarse: CoarseCloud, most: int) -> list[Motion]:
    """Return reflections that matching points propose, the best on the coarse cloud first."""
    first, second = pairs
    points, normals = surface.points, surface.normals
    gap = points[second] - points[first]
    length = np.linalg.norm(gap, axis=1)
    direction = gap / length[:, None]
    mirrored = normals[first] - 2 * np.einsum("ni,ni->n", normals[first], direction)[:, None] * direction
    fits = np.abs(np.einsum("ni,ni->n", mirrored, normals[second])) > math.cos(math.radians(25))
    direction, middle = direction[fits], ((points[first] + points[second]) / 2)[fits]
    linear = np.eye(3) - 2 * direction[:, :, None] * direction[:, None, :]
    order = np.argsort(-coarse.score(linear, middle))[: 60 * most]
    return distinct([Motion(direction[row], middle[row], None) for row in order], most=most)


def turns_of_pairs(surface: Neighborhoods, pairs: Pairs, *, coarse: CoarseCloud, most: int) -> list[Motion]:
    """Return turns that matching points propose, the best on the coarse cloud first, about axes that differ."""
    first, second = pairs
    directions, places, angles = [], [], []
    for sign in (1.0, -1.0):
        start, end = surface.points[first], surface.points[second]
        before, after = surface.normals[first], sign * surface.normals[second]
        gap = end - start
        # A turn changes nothing along its axis: neither the normal nor the place.
        axis = np.cross(after - before, gap)
        size = np.linalg.norm(axis, axis=1)
        parallel = np.linalg.norm(after - before, axis=1) < 0.2
        crossing = ~parallel & (size > 0.2 * np.linalg.norm(gap, axis=1))
        axis = axis / np.maximum(size, 1e-12)[:, None]
        flat_before = before - np.einsum("ni,ni->n", before, axis)[:, None] * axis
        flat_after = after - np.einsum("ni,ni->n", after, axis)[:, None] * axis
        sine = np.einsum("ni,ni->n", np.cross(flat_before, flat_after), axis)
        angle = np.arctan2(sine, np.einsum("ni,ni->n", flat_before, flat_after))
        turned = crossing & (np.abs(angle) > math.radians(25))
        away = np.cross(axis, gap) / (2 * np.tan(np.where(turned, angle, 1.0) / 2))[:, None]
        directions += [axis[turned], before[parallel]]
        places += [((start + end) / 2 + away)[turned], ((start + end) / 2)[parallel]]
        angles += [angle[turned], np.full(int(parallel.sum()), math.pi)]
    axis, place, angle = np.concatenate(directions), np.concatenate(places), np.concatenate(angles)
    near = np.linalg.norm(place - surface.points.mean(0), axis=1) < 1.0
    axis, place, angle = axis[near], place[near], angle[near]
    linear = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    order = np.argsort(-coarse.score(linear, place))[: 60 * most]
    return distinct([Motion(axis[row], place[row], float(angle[row])) for row in order], most=most)


def distinct(motions: list[Motion], *, most: int) -> list[Motion]:
    """Return the first motions whose planes or axes differ from those before them."""
    chosen: list[Motion] = []
    for motion in motions:
        if len(chosen) == most:
            break
        gaps = (motion.separation(other) for other in chosen)
        if not any(degrees < _SAME_DEGREES and gap < _SAME_GAP for degrees, gap in gaps):
            chosen.append(motion)
    return chosen


def matching_pairs(surface: Neighborhoods, *, generator: np.random.Generator) -> Pairs:
    """Return rows of points that are far from one another and about which the surface is alike."""
    rows = draw_by_area(surface, _DESCRIBED, generator)
    counted = generator.choice(len(surface.points), min(_COUNTED, len(surface.points)), replace=False)
    described = describe_neighborhoods(surface, rows, counted, diagonal=1.0)
    squares = (described**2).sum(axis=1)
    unlike = squares[:, None] + squares - 2 * described @ described.T
    places = surface.points[rows]
    unlike[((places[:, None] - places) ** 2).sum(axis=2) < 0.1**2] = np.inf
    partners = np.argpartition(unlike, _PARTNERS, axis=1)[:, :_PARTNERS]
    first = np.repeat(np.arange(len(rows)), _PARTNERS)
    second = partners.ravel()
    fine = np.isfinite(unlike[first, second])
    return rows[first[fine]], rows[second[fine]]
