"""The vibrations of an elastic body: natural frequencies, and how far each place moves in each."""

from dataclasses import dataclass

from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.simulate.material import Material


@dataclass(frozen=True, eq=False)
class ElasticModes:
    """Undamped modes of a body by ascending frequency, without the motions of a rigid body.

    A force j [newton seconds] at a place x sets mode k in motion with the velocity shape_k(x) . j.
    """

    frequency: Float64[Tensor, " modes"]
    """Undamped natural frequencies, Hz."""
    nodes: Float64[Tensor, "nodes 3"]
    """Places on the body's surface at which the shapes are known: corners and edge middles of its triangles, metres."""
    triangles: Int[Tensor, "triangles 6"]
    """Rows of `nodes`: three corners, counter-clockwise from outside, then the middles of the edges 01, 12 and 20."""
    shapes: Float64[Tensor, "nodes modes 3"]
    """Mass-normalised displacement, 1 / sqrt(kg): the integral of density times its square over the body is 1."""
    material: Material
    mass: float
    """Kilograms."""

    def __len__(self) -> int:
        return self.frequency.shape[0]

    def at(self, places: Float[Tensor, "contacts 3"]) -> Float64[Tensor, "contacts modes 3"]:
        """Return the shapes where the surface is nearest to each place, interpolated as the elements do."""
        raise NotImplementedError
