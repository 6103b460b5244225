"""An object made by rule, and what is known of it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.fem.solid import Solid
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.simulate.shapes.body import Body


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Rotations about one axis and mirror planes that are symmetries of a shape; compositions are not listed."""

    axis: Float64[Tensor, " 3"] | None = None
    """Direction of the axis, a unit vector; None where no turn is a symmetry."""
    order: int | None = None
    """Turns by 1/order are symmetries; None with an axis means every angle (of the shape that the triangles
    approximate), and every plane that contains the axis."""
    mirrors: Float64[Tensor, "planes 3"] = field(default_factory=lambda: torch.zeros(0, 3).double())
    """Unit normals of mirror planes, apart from those that contain an axis of every angle."""
    point: Float64[Tensor, " 3"] = field(default_factory=lambda: torch.zeros(3).double())
    """A point of the axis and of all planes, object frame, meters."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One individual of a kind: upright along z, its axis, if any, the z axis."""

    name: str
    """Kind and seed, such as "mug-3"."""
    surface: Surface
    """Closed triangles, counter-clockwise from outside, meters: the solid's surface, with its triangles subdivided."""
    colors: Float[Tensor, "points 3"]
    """Red, green, blue at each vertex of the surface as displayed (sRGB), 0 to 1."""
    thickness: float
    """Nominal thickness of the walls, meters; of a lump without walls its smallest extent."""
    symmetry: Symmetry
    """Of the shape; colors need not follow it."""
    solid: Solid
    """Tetrahedra, in the surface to rounding."""


def textured(shape: Shape) -> TexturedMesh:
    """Return a shape's surface in its colors, to render it with `avmsf.photographs.mesh_views.render_views`."""
    faces = shape.surface.faces
    return TexturedMesh.build(shape.surface.vertices, faces, colors=shape.colors[faces])


@dataclass(frozen=True, eq=False)
class Draft:
    """A shape without its colors."""

    body: Body
    wall: float
    """Nominal thickness, meters."""
    symmetry: Symmetry


Maker = Callable[[np.random.Generator, float | None], Draft]
"""Draws the proportions of one individual; walls as thick as told, meters, or drawn too."""


def drawn_wall(random: np.random.Generator, low: float, high: float, wall: float | None) -> float:
    """Return the wall that was asked for, or one between two bounds, meters; draws in both cases."""
    drawn = random.uniform(low, high)
    return drawn if wall is None else wall
