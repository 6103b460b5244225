"""A picture of an object's surface: seen from a side a little above, and cut through its middle along two planes."""

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from torch import Tensor

from avmsf.errors import EvaluationError
from avmsf.mesh.surface import Surface
from avmsf.plotting.clouds import ALL_SIDES, name_axes, view_from
from avmsf.plotting.style import FIRST, SECOND, styled, titled_figure

_LIGHT = np.array([-0.4, 0.5, 0.77])
"""Direction to the light in the picture's frame: right, up, towards the eye; of unit length."""
_MILLIMETERS = 1000.0
_NEAR = 0.1
"""Distance from a cut up to which contacts are drawn on it, over the diagonal of the surface's box."""


@styled
def draw_surface(surface: Surface, *, title: str, contacts: Float[Tensor, "contacts 3"] | None = None) -> Figure:
    """Draw a surface of triangles (object frame, meters), and its cuts through the middle of its box, in millimeters.

    One cut is along x and z, one along y and z: walls and cavities of what stands upright show in both. `contacts` are
    dots, on a cut those within a tenth of the diagonal of it. Raises EvaluationError for a surface without triangles.
    """
    if not len(surface.faces):
        raise EvaluationError.expected("triangles", 0, got=f"{len(surface.vertices)} points", name="surface")
    mesh = trimesh.Trimesh(_MILLIMETERS * surface.vertices.double().numpy(), surface.faces.numpy(), process=False)
    marks = np.zeros((0, 3)) if contacts is None else _MILLIMETERS * contacts.double().numpy()
    figure = titled_figure(title, 14, 5)
    whole, *cuts = figure.subplots(1, 3)
    _shade(whole, mesh)
    dots: dict[str, Any] = {"marker": "o", "linestyle": "", "color": SECOND, "markersize": 4}
    if len(marks):
        seen = marks @ view_from(ALL_SIDES[0]).T
        whole.plot(seen[:, 0], seen[:, 1], label="contacts", **dots)
        whole.legend(loc="upper right")
    middle, diagonal = mesh.bounds.mean(axis=0), float(np.linalg.norm(mesh.extents))
    for axes, across in zip(cuts, (0, 1), strict=True):
        _cut(axes, mesh, middle, across=across)
        near = marks[np.abs(marks[:, 1 - across] - middle[1 - across]) < _NEAR * diagonal]
        axes.plot(near[:, across], near[:, 2], **dots)
    return figure


def _shade(axes: Axes, mesh: trimesh.Trimesh) -> None:
    """Draw the triangles from the farthest to the nearest, lit from above."""
    view = view_from(ALL_SIDES[0])
    corners = mesh.triangles @ view.T
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    # Either side of a triangle is lit alike: thin sheets and wrong windings look as they should.
    light = 0.35 + 0.6 * np.abs(mesh.face_normals @ view.T @ _LIGHT)
    gray = np.repeat(light[order, None].clip(0, 1), 3, axis=1)
    axes.add_collection(
        PolyCollection(list(corners[order][:, :, :2]), facecolors=gray, edgecolors=gray, linewidths=0.2)
    )
    axes.autoscale_view()
    axes.set_aspect("equal")
    name_axes(axes, view)


def _cut(axes: Axes, mesh: trimesh.Trimesh, middle: np.ndarray, *, across: int) -> None:
    """Draw where a plane along z and one other axis cuts the triangles."""
    normal = np.eye(3)[1 - across]
    lines = trimesh.intersections.mesh_plane(mesh, normal, middle)  # type: ignore[no-untyped-call]
    axes.add_collection(LineCollection(list(lines[:, :, [across, 2]]), colors=FIRST, linewidths=1.5))
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_title(f"cut at {'xy'[1 - across]} = {middle[1 - across]:.3g} mm")
    axes.set(xlabel=f"{'xy'[across]} (mm)", ylabel="z (mm)")
    axes.grid()
