"""Where rays meet a mesh, by Embree."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float64, Int


class RayCaster:
    """Casts rays against triangles [triangles, 3, 3], meters.

    Embree computes in float32, so the triangles are moved to the origin and given size 1.
    """

    def __init__(self, triangles: Float64[np.ndarray, "triangles 3 3"]) -> None:
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        self._middle, self._size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self._scene = EmbreeScene()
        # The scene does not keep it alive.
        self._mesh = TriangleMesh(self._scene, ((triangles - self._middle) / self._size).astype(np.float32))

    def __call__(
        self, origins: Float64[np.ndarray, "rays 3"], directions: Float64[np.ndarray, "rays 3"], *, lead: float
    ) -> tuple[Int[np.ndarray, " rays"], Float64[np.ndarray, " rays"]]:
        """Return the triangle that each ray meets first, -1 for none, and its distance, infinite for none, meters.

        `directions` are unit vectors. Rays start `lead` times the triangles' size from their origins, so that those
        that leave a triangle do not meet it.
        """
        rows, _, distances = self.hits(origins, directions, lead=lead)
        return rows, distances

    def hits(
        self, origins: Float64[np.ndarray, "rays 3"], directions: Float64[np.ndarray, "rays 3"], *, lead: float
    ) -> tuple[Int[np.ndarray, " rays"], Float64[np.ndarray, "rays 3"], Float64[np.ndarray, " rays"]]:
        """Return the triangles and distances as a call does, and between them the points' barycentric coordinates."""
        starts = (origins - self._middle) / self._size + lead * directions
        hits = self._scene.run(starts.astype(np.float32), directions.astype(np.float32), output=1)
        rows, u, v = hits["primID"].astype(np.int64), hits["u"].astype(np.float64), hits["v"].astype(np.float64)
        distances = np.where(rows >= 0, (hits["tfar"].astype(np.float64) + lead) * self._size, np.inf)
        return rows, np.stack([1 - u - v, u, v], axis=1), distances
