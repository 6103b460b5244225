"""Triangle meshes and points: files, colors, level sets, distances and differences, choosing points, normals.

In go files (`.obj`, `.ply`, `.glb`, `.gltf`, `.stl`, `.off`) or arrays; out come two types. `Surface` is the shape
alone: vertices [points, 3] in meters and triangles [faces, 3], or points without triangles. `TexturedMesh` adds, at
each corner of a face, a normal, a color and a place in a texture.

- `io.load_mesh` is the one door for files: bounded in size before and after, indices and coordinates checked.
- `surface`: points drawn evenly by area (`sample_surface`, `surface_points`), and the part that contacts lie on.
- `points`: farthest point sampling, nearest points and k-means. `neighborhoods`: normals and shape descriptors of a
  cloud (spin images, Johnson and Hebert 1999).
- `textured_mesh`: smooth normals with sharp edges (means over faces weighted by angles, Thürmer and Wüthrich 1998).
- `level_set`: marching cubes (Lewiner et al. 2003, by scikit-image), decimation by quadrics (Garland and Heckbert 1997,
  by fast-simplification), and differences of solids (by manifold3d).
- `queries`: the closest point of a surface, exactly, with the triangle and its barycentric coordinates; the triangle
  that a ray meets first, and how far away it is (Embree).

Pictures of a mesh are made in `avmsf.photographs`, its walls in `avmsf.reconstruction` and `avmsf.fem`. Start reading
with `surface.Surface`, then `io`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
