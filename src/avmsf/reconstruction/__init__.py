"""The shape of an object from masks and depth of many views: its outer side, its cavities, the bodies it may be.

In go `View`s with masks, and a `DepthMap`, which gives the depth that a camera sees (of Gaussians, or of a mesh); out
comes an `ObjectShape`: signed distances on a grid, from which `solid`, `as_seen` and `shell(thickness)` draw closed
surfaces (marching cubes, `avmsf.mesh.level_set`). Views do not show how thick a wall is; recordings do.

`outer_surface.object_surface` is the whole way; start reading there. Its steps:

1. `outlines`: masks that contradict the consensus of the others are left out, and outlines are moved to the edges in
   the photographs.
2. `outlines.hull_distance`: how far inside all outlines each cell lies, a signed distance.
3. `fairing`: the hull stretched as a membrane (Laplace's equation) between the points that outlines touch, since
   cameras below a flat top leave a low pyramid on it.
4. `depth_fusion`: the distance of each cell before the depth that most views see (a quantile over views), less the bias
   of that depth (its half-sample mode).
5. `outer_surface`: what no view sees is closed by the convex hull of what views see; space that is seen to be free
   within the hull is a cavity. Faces that no outline touches may be openings: cavities are then supposed.
6. `object_shape`: the result, its report, and the bodies. `distance`: distances from the surface (fast sweeping), and
   from a convex hull.

Raises SceneError where views do not bound the object or their masks have nothing in common.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
