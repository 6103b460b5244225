"""Symmetries of a shape: rotations and reflections that carry an object onto itself, found on a cloud of its surface.

`find.find_symmetries` takes points [points, 3] in meters and returns `symmetries.Symmetries`: each `RotationalSymmetry`
has an axis and an order (None where every angle will do), each `MirrorSymmetry` a plane, and both an error in point
spacings. Together they are always one point group, exactly. `characters.groups_of` returns its subgroups with the real
characters by which mode shapes are even or odd.

1. `candidates`: planes and axes along the principal axes, and those by which pairs of points with similar neighborhoods
   would change places (Mitra, Guibas and Pauly, Partial and Approximate Symmetry Detection, 2006), ranked on a distance
   grid.
2. `alignment`: the error of motions, by cross-validation, and the iterative closest point method (point to plane,
   Geman-McClure weights) that moves one motion or a whole group to its least error.
3. `point_group`: the group that a few motions generate: the closed subgroups of O(3).
4. `find`: orders of axes by their evidence, and the largest group that holds.

Start reading with `find.find_group`; `motions.Motions` are what all of these pass on.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
