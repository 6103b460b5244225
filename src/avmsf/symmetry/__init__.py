"""Symmetries of a shape: rotations and reflections that carry an object onto itself, found on a cloud of its surface.

`find_symmetries` takes points [points, 3] in meters and returns `Symmetries`: each `RotationalSymmetry` has an axis and
an order (None where every angle will do), each `MirrorSymmetry` a plane, and both an error in point spacings.
`characters.groups_of` returns the groups that they form, with the real characters by which mode shapes are even or odd.

1. `candidates`: planes and axes along the principal axes, and those by which pairs of points with similar neighborhoods
   would change places (Mitra, Guibas and Pauly, Partial and Approximate Symmetry Detection, 2006), ranked on a distance
   grid.
2. `alignment`: the error of a motion, from one half of the cloud to the surface that the other samples, and the
   iterative closest point method (point to plane, Geman-McClure weights) that moves a plane or axis to its least error.
3. `order`: how many turns of an axis make a whole one.
4. `group`: closure under composition, and the planes and axes that are found twice or that follow from another.

Start reading with `find.find_symmetries`; `motion.Motion` is the reflection or turn that all of these pass on.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
