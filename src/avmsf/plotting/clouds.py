"""Pictures of a cloud from all sides: its colors, features, clusters and symmetries, as a sheet or a turntable."""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import hsv_to_rgb
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.features.feature_field import FeatureField
from avmsf.gaussians.points import cluster
from avmsf.plotting.sides import ABOVE, AROUND, UP, Side, name_axes, side_words, view_from
from avmsf.plotting.style import FIRST, SECOND, styled
from avmsf.symmetry.symmetries import Symmetries

_GRAY = 0.62
_INCHES, _TURNTABLE_INCHES = 3.0, 4.0
_MARGIN = 1.12
_WIDTH = 1.9
"""Width of a dot over the picture's, times the root of how many there are."""
_FEW = 400
"""Points below which dots grow no wider."""


@styled
def draw_cloud(
    points: Float[Tensor, "points 3"],
    colors: Mapping[str, Float[Tensor, "points 3"]],
    *,
    title: str,
    symmetries: Symmetries | None = None,
    sides: Sequence[Side] = AROUND,
    up: Sequence[float] = UP,
) -> Figure:
    """Draw a cloud from each side in a column, once for every named set of colors (0 to 1) in a row.

    Symmetries get a row of their own: axes as lines with their order, mirror planes as outlines. `up` is the direction
    that points to the sky. Raises EvaluationError where there is nothing to draw.
    """
    rows = dict(colors)
    if symmetries is not None:
        rows["symmetries"] = torch.full((len(points), 3), _GRAY)
    if not rows or not sides or not len(points):
        raise EvaluationError(
            f"expected points, colors or symmetries, and sides to draw, got {len(points)} points, {len(rows)} sets of "
            f"colors and {len(sides)} sides",
            value=(len(points), len(rows), len(sides)),
        )
    figure = Figure(figsize=(_INCHES * len(sides), _INCHES * len(rows) + 0.5), layout="constrained")
    grid = figure.subplots(len(rows), len(sides), squeeze=False)
    for (name, shown), line in zip(rows.items(), grid, strict=True):
        for side, axes in zip(sides, line, strict=True):
            view = view_from(side, up)
            _scatter(axes, points, shown, view, inches=_INCHES)
            if symmetries is not None and name == "symmetries":
                _draw_symmetries(axes, points, symmetries, view)
            name_axes(axes, view)
            axes.set_title(f"{name}\n{side_words(side)}")
    figure.suptitle(title)
    return figure


def draw_features(
    features: FeatureField,
    *,
    title: str,
    colors: Float[Tensor, "points 3"] | None = None,
    clusters: int | None = None,
    symmetries: Symmetries | None = None,
    sides: Sequence[Side] = AROUND,
    up: Sequence[float] = UP,
) -> Figure:
    """Draw what is known of an object's points, as `draw_cloud` does.

    Rows: the points in their own colors if given, their features' first three principal components as red, green and
    blue, `clusters` k-means groups if asked for, and the symmetries if given.
    """
    rows = {} if colors is None else {"color": colors}
    rows["features"] = component_colors(features.features)
    if clusters is not None:
        rows[f"{clusters} clusters"] = label_colors(cluster(features.points, clusters).labels)
    return draw_cloud(features.points, rows, title=title, symmetries=symmetries, sides=sides, up=up)


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


def label_colors(labels: Int[Tensor, " points"]) -> Float[Tensor, "points 3"]:
    """Return a color for each label; labels that follow one another get hues far apart."""
    number = labels.numpy()
    hue = (number * 0.618034) % 1.0
    saturation = 0.55 + 0.4 * ((number * 0.37) % 1.0)
    value = 0.6 + 0.4 * ((number * 0.73) % 1.0)
    return torch.from_numpy(hsv_to_rgb(np.stack([hue, saturation, value], axis=1))).float()


@styled
def save_turntable(
    points: Float[Tensor, "points 3"],
    colors: Float[Tensor, "points 3"],
    path: Path,
    *,
    symmetries: Symmetries | None = None,
    frames: int = 36,
    up: Sequence[float] = UP,
) -> None:
    """Write an animated GIF of the cloud turning once in three seconds. Raises EvaluationError for another ending."""
    if path.suffix.lower() != ".gif" or frames < 2:
        raise EvaluationError.expected(
            "a name that ends in .gif and 2 frames or more", frames, got=f"{frames} frames", file=path, name="frames"
        )
    pictures = []
    for frame in range(frames):
        figure = Figure(figsize=(_TURNTABLE_INCHES, _TURNTABLE_INCHES), dpi=100)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        view = view_from((360.0 * frame / frames, ABOVE), up)
        _scatter(axes, points, colors, view, inches=_TURNTABLE_INCHES)
        if symmetries is not None:
            _draw_symmetries(axes, points, symmetries, view)
        still = io.BytesIO()
        FigureCanvasAgg(figure).print_figure(still, format="png", dpi=100)
        pictures.append(Image.open(still).convert("RGB"))
    memory = io.BytesIO()
    first, *others = pictures
    first.save(memory, format="GIF", save_all=True, append_images=others, duration=round(3000 / frames), loop=0)
    write_whole(path, lambda place: place.write_bytes(memory.getvalue()))


def _middle(points: Float[Tensor, "points 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    places = points.double().numpy()
    middle = (places.min(0) + places.max(0)) / 2
    return middle, float(np.linalg.norm(places - middle, axis=1).max())


def _scatter(
    axes: Axes,
    points: Float[Tensor, "points 3"],
    colors: Float[Tensor, "points 3"],
    view: Float[np.ndarray, "3 3"],
    *,
    inches: float,
) -> None:
    middle, radius = _middle(points)
    seen = (points.double().numpy() - middle) @ view.T
    order = np.argsort(seen[:, 2])
    # What is farther is darker: flat dots alone show no depth.
    shade = 0.72 + 0.28 * (seen[:, 2:] / max(radius, 1e-30) + 1) / 2
    shown = np.clip(colors.numpy() * shade, 0.0, 1.0)
    # Dots so wide that near ones hide far ones: about twice as wide as they lie apart.
    dot = 72 * inches * _WIDTH / math.sqrt(max(len(seen), _FEW))
    axes.scatter(seen[order, 0], seen[order, 1], c=shown[order], s=dot**2, linewidths=0, rasterized=True)
    reach = _MARGIN * radius if radius > 0.0 else 1.0
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_symmetries(
    axes: Axes, points: Float[Tensor, "points 3"], symmetries: Symmetries, view: Float[np.ndarray, "3 3"]
) -> None:
    middle, radius = _middle(points)
    for mirror in symmetries.mirrors:
        normal, point = mirror.normal.double().numpy(), mirror.point.double().numpy()
        center = middle - ((middle - point) @ normal) * normal
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        signs = ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))
        corners = np.array([center + 0.72 * radius * (a * first + b * second) for a, b in signs])
        seen = (corners - middle) @ view.T
        axes.plot(seen[:, 0], seen[:, 1], color=FIRST, linewidth=1.0, alpha=0.8)
    for rotation in symmetries.rotations:
        axis, point = rotation.axis.double().numpy(), rotation.point.double().numpy()
        center = point + ((middle - point) @ axis) * axis
        ends = np.array([center - 1.05 * radius * axis, center + 1.05 * radius * axis])
        seen = (ends - middle) @ view.T
        axes.plot(seen[:, 0], seen[:, 1], color=SECOND, linewidth=1.6)
        name = "∞" if rotation.order is None else f"{rotation.order}"
        axes.annotate(name, (seen[1, 0], seen[1, 1]), color=SECOND, annotation_clip=False)
