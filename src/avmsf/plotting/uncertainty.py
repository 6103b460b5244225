"""Pictures of predictive uncertainty over an object, from several sides, with contacts."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from avmsf.plotting.clouds import ALL_SIDES, in_front, name_axes, plane_of, view_from
from avmsf.plotting.style import SECOND, SEQUENTIAL, scatter_surface, styled, titled_figure


@styled
def draw_uncertainty(
    points: Float[Tensor, "points 3"],
    std: Float[Tensor, " points"],
    *,
    title: str,
    contacts: Float[Tensor, "struck 3"] | None = None,
    suggested: Float[Tensor, "suggested 3"] | None = None,
    directions: Float[Tensor, "suggested 3"] | None = None,
) -> Figure:
    """Draw `SoundField.relative_gain_std` on an object's points (object frame, meters).

    From six sides. Recorded `contacts` are marked by crosses, `suggested` ones by their numbers, each where it
    is visible: no point is in front of it, and the impact, whose `directions` may be given, points away from the
    viewer, so that the two sides of a wall are distinguished. A suggested one that no side shows is drawn in a white
    disc, on the side that most faces it. An object that is flat along an axis is drawn once, in its plane.
    """
    places, values = points.double().numpy(), std.double().numpy()
    crosses, numbers = (None if each is None else each.double().numpy() for each in (contacts, suggested))
    plane = plane_of(places)
    frames = [view_from(side).T for side in ALL_SIDES] if plane is None else [plane.T]
    figure = titled_figure("", 14, 9.5) if len(frames) > 1 else titled_figure("", 8, 5)
    grid = figure.subplots(2, 3).flatten() if len(frames) > 1 else np.array([figure.subplots()])
    scale: dict[str, Any] = {"cmap": SEQUENTIAL, "vmin": 0.0, "vmax": max(float(values.max()), 1e-12)}
    for axes, frame in zip(grid, frames, strict=True):
        drawn = scatter_surface(axes, places @ frame, values, inches=4.0, **scale)
        name_axes(axes, frame.T)
        if crosses is not None:
            visible = (crosses @ frame)[in_front(places @ frame, crosses @ frame)]
            for color, size, width in (("white", 45, 3.5), ("black", 35, 1.5)):
                axes.scatter(visible[:, 0], visible[:, 1], c=color, marker="x", s=size, linewidths=width)
    hidden = False
    if numbers is not None:
        away = None if directions is None or len(frames) == 1 else directions.double().numpy()
        hidden = _number(grid, frames, places, numbers, away)
    figure.colorbar(drawn, ax=list(grid), shrink=0.7, label="standard deviation of gains / rms gain")
    known = [words for words, each in (("× recorded", contacts), ("numbers: suggested", suggested)) if each is not None]
    known += ["white discs: hidden contacts"] * hidden
    figure.suptitle("\n".join([title, ", ".join(known)] if known else [title]))
    return figure


def _number(
    grid: np.ndarray, frames: list[np.ndarray], places: np.ndarray, marks: np.ndarray, away: np.ndarray | None
) -> bool:
    """Draw each mark's number on all sides that show it, or on one of those that do not; return if there are such."""
    faces = np.stack([np.zeros(len(marks)) if away is None else -(away @ frame)[:, 2] for frame in frames])
    shown = np.stack([in_front(places @ frame, marks @ frame) for frame in frames])
    if away is not None:
        shown &= faces > 0
    hidden = np.logical_not(shown.any(axis=0))
    shown[faces.argmax(axis=0)[hidden], np.flatnonzero(hidden)] = True
    for axes, frame, rows in zip(grid, frames, shown, strict=True):
        across, along = (marks @ frame)[:, 0], (marks @ frame)[:, 1]
        colors = np.where(hidden[rows], "white", SECOND)
        axes.scatter(across[rows], along[rows], c=colors, s=190, edgecolors="black", linewidths=1)
        for row in np.flatnonzero(rows).tolist():
            place = (float(across[row]), float(along[row]))
            axes.annotate(str(row + 1), place, ha="center", va="center", fontsize=9, fontweight="bold")
    return bool(hidden.any())
