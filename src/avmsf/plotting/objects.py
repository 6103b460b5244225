"""Pictures of an object from several sides: a cloud's colors, features and symmetries; a surface and its cuts."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from torch import Tensor

from avmsf.errors import EvaluationError
from avmsf.mesh.surface import Surface
from avmsf.plotting.style import FIRST, SECOND, scatter_surface, styled, titled_figure
from avmsf.symmetry.symmetries import Symmetries

Side: TypeAlias = tuple[float, float]
"""Azimuth about z, which points to the sky, from x towards y, and elevation above the horizon, of an eye far away;
degrees."""
AROUND: tuple[Side, ...] = ((30.0, 25.0), (120.0, 25.0), (210.0, 25.0), (300.0, 25.0))
"""Four sides from a little above, from where an eye looks into what is open above and still sees the sides."""
ALL_SIDES: tuple[Side, ...] = (
    *((-60.0, 25.0), (60.0, 25.0), (180.0, 25.0), (-60.0, 75.0), (-60.0, -25.0), (-60.0, -75.0)),
)
"""Three sides, into what is open above, and two from below: nothing on a convex object is out of sight in all."""
_ARROW = 28.0
"""Length of the arrows along the axes, points."""


def view_from(side: Side) -> Float[np.ndarray, "3 3"]:
    """Return rows right, up and towards the eye of a side."""
    angle, height = map(math.radians, side)
    right = np.array([-math.sin(angle), math.cos(angle), 0.0])
    eye = np.array([math.cos(height) * math.cos(angle), math.cos(height) * math.sin(angle), math.sin(height)])
    return np.stack([right, np.cross(eye, right), eye])


def plane_of(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "3 3"] | None:
    """Return the rows of `view_from` for points that are flat along an axis, seen along it; None for others."""
    extent = np.ptp(points, axis=0)
    thin = int(extent.argmin())
    wide = [axis for axis in range(3) if axis != thin]
    return np.eye(3)[[*wide, thin]] if extent[thin] <= 1e-3 * extent.max() else None


def name_axes(axes: Axes, view: Float[np.ndarray, "3 3"]) -> None:
    """Draw the directions of x, y and z in the lower left corner, in place of axes; rows of `view` as `view_from`."""
    axes.set_axis_off()
    for axis, name in enumerate("xyz"):
        across, along = _ARROW * view[:2, axis]
        # What points at the eye or away from it has no direction here.
        if np.hypot(across, along) > 0.4 * _ARROW:
            how: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "center", "color": FIRST}
            arrow = {"arrowstyle": "<-", "color": FIRST}
            axes.annotate(name, (0.06, 0.06), (across, along), "axes fraction", arrowprops=arrow, **how)


_BEHIND = 0.04
"""Depth over the object's size by which a point in front hides a mark."""


def in_front(seen: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return which marks no point hides, both in a side's own frame."""
    size = float(np.linalg.norm(np.ptp(seen, axis=0)))
    apart = np.linalg.norm(seen[None, :, :2] - marks[:, None, :2], axis=2)
    nearer = seen[None, :, 2] - marks[:, None, 2] > _BEHIND * size
    visible: np.ndarray = ~np.any((apart < size / math.sqrt(len(seen))) & nearer, axis=1)
    return visible


_INCHES = 3.0
"""Width of an object in its picture."""


@styled
def draw_cloud(
    points: Float[Tensor, "points 3"],
    colors: Mapping[str, Float[Tensor, "points 3"]],
    *,
    title: str,
    symmetries: Symmetries | None = None,
    sides: Sequence[Side] = AROUND,
) -> Figure:
    """Draw a cloud from each side in a column, once for every named set of colors (0 to 1) in a row.

    Symmetries get a row of their own: axes as lines with their order, mirror planes as outlines. Raises EvaluationError
    where there is nothing to draw.
    """
    rows = dict(colors)
    if symmetries is not None:
        rows["symmetries"] = torch.full((len(points), 3), 0.62)
    counts = (len(points), len(rows), len(sides))
    if not all(counts):
        got = "{} points, {} sets of colors and {} sides".format(*counts)
        raise EvaluationError.expected("points, colors or symmetries, and sides", counts, got=got, name="cloud")
    figure = titled_figure(title, _INCHES * len(sides), _INCHES * len(rows) + 0.5)
    grid = figure.subplots(len(rows), len(sides), squeeze=False)
    places = points.double().numpy()
    middle = (places.min(0) + places.max(0)) / 2
    radius = float(np.linalg.norm(places - middle, axis=1).max())
    for (name, shown), line in zip(rows.items(), grid, strict=True):
        for side, axes in zip(sides, line, strict=True):
            view = view_from(side)
            seen = (places - middle) @ view.T
            # What is farther is darker: flat dots alone show no depth.
            shade = 0.72 + 0.28 * (seen[:, 2:] / max(radius, 1e-30) + 1) / 2
            scatter_surface(axes, seen, np.clip(shown.numpy() * shade, 0.0, 1.0), inches=_INCHES)
            if symmetries is not None and name == "symmetries":
                _draw_symmetries(axes, middle, radius, symmetries, view)
            name_axes(axes, view)
            reach = 1.12 * radius if radius > 0.0 else 1.0
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
            axes.set_title("{}\nazimuth {:g}°, elevation {:g}°".format(name, *side))
    return figure


def component_colors(features: Float[Tensor, "points dim"]) -> Float[Tensor, "points 3"]:
    """Return the first three principal components as red, green and blue, from the 2nd to the 98th percentile.

    Each component's largest weight is positive. What features do not fill, of fewer than three, stays gray.
    """
    centered = (features - features.mean(0)).double()
    _, sizes, directions = torch.linalg.svd(centered, full_matrices=False)
    colors = torch.full((len(features), 3), 0.5)
    for column, (size, direction) in enumerate(zip(sizes[:3].tolist(), directions, strict=False)):
        if size < 1e-6 * max(1.0, float(sizes[0])) or size == 0.0:
            break
        value = centered @ (direction * torch.sign(direction[direction.abs().argmax()]))
        low, high = np.quantile(value.numpy(), [0.02, 0.98])
        colors[:, column] = ((value - low) / max(high - low, 1e-12)).clamp(0.0, 1.0).float()
    return colors


def _draw_symmetries(
    axes: Axes, middle: Float[np.ndarray, " 3"], radius: float, symmetries: Symmetries, view: Float[np.ndarray, "3 3"]
) -> None:
    for mirror in symmetries.mirrors:
        normal, point = mirror.normal.double().numpy(), mirror.point.double().numpy()
        center = middle - ((middle - point) @ normal) * normal
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)])
        seen = (center + 0.72 * radius * signs @ [first, second] - middle) @ view.T
        axes.plot(seen[:, 0], seen[:, 1], color=FIRST, linewidth=1.0, alpha=0.8)
    for rotation in symmetries.rotations:
        axis, point = rotation.axis.double().numpy(), rotation.point.double().numpy()
        center = point + ((middle - point) @ axis) * axis
        seen = (center + 1.05 * radius * np.array([-axis, axis]) - middle) @ view.T
        axes.plot(seen[:, 0], seen[:, 1], color=SECOND, linewidth=1.6)
        name = "∞" if rotation.order is None else f"{rotation.order}"
        axes.annotate(name, (seen[1, 0], seen[1, 1]), color=SECOND, annotation_clip=False)


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
