"""Pictures of what is uncertain over an object, from all sides: where a contact was, and predicted gains."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from avmsf.localization.contact_map import ContactPosterior
from avmsf.plotting.objects import ALL_SIDES, draw_cloud, in_front, name_axes, plane_of, view_from
from avmsf.plotting.style import FIRST, SECOND, SEQUENTIAL, scatter_surface, styled, titled_figure

_DECADES = 3.0
"""Powers of ten below the likeliest that colors tell apart."""
_LEGEND = {FIRST: "blue: most probable", "white": "white: equivalent", SECOND: "red: true contact"}
"""Colors of marks; blue and red are the paper's of the found and the true contact."""
_DRAWN = 6000
"""Points in a picture, about."""


@styled
def draw_contact(
    contact: ContactPosterior,
    *,
    title: str,
    others: Float[Tensor, "others 3"] | None = None,
    truth: Float[Tensor, " 3"] | None = None,
) -> Figure:
    """Draw the probability of a contact over the object, and below it the paper's cosine distance, from all sides.

    The most probable contact is marked blue, equivalent `others` white, and the true contact, `truth`, red if given.
    """
    points = contact.points
    # The likeliest point and its neighborhood must not fall between those that are drawn.
    rows = torch.arange(0, len(points), max(1, len(points) // _DRAWN))
    rows = torch.unique(torch.cat([rows, torch.topk(contact.probability, min(64, len(points))).indices]))
    marks = [] if others is None else [("white", each) for each in others]
    marks += [(FIRST, contact.position), *([] if truth is None else [(SECOND, truth)])]
    low, high = float(contact.distance.min()), float(contact.distance.max())
    high = max(high, low + 1e-6)
    colors = {
        "probability": contact_colors(contact)[rows],
        "cosine distance": _heat(1.0 - (contact.distance.double() - low) / (high - low))[rows],
    }
    legend = ", ".join(words for color, words in _LEGEND.items() if color in dict(marks))
    figure = draw_cloud(points[rows], colors, title=f"{title}\n{legend}", sides=ALL_SIDES)
    panels = np.array(figure.axes).reshape(len(colors), -1)
    drawn, places = points[rows].double().numpy(), np.stack([each.double().numpy() for _, each in marks])
    middle, edges = (drawn.min(0) + drawn.max(0)) / 2, np.array([color for color, _ in marks])
    for axes, side in zip(panels.flat, ALL_SIDES * len(colors), strict=True):
        frame = view_from(side).T
        visible = in_front(drawn @ frame, places @ frame)
        spots = (places[visible] - middle) @ frame
        axes.scatter(spots[:, 0], spots[:, 1], s=80, facecolors="none", edgecolors=edges[visible], linewidths=2)
    likely = ScalarMappable(Normalize(-_DECADES, 0.0), SEQUENTIAL)
    figure.colorbar(likely, ax=list(panels[0]), shrink=0.75, label="log10 of probability / maximum")
    distant = ScalarMappable(Normalize(low, high), f"{SEQUENTIAL}_r")
    figure.colorbar(distant, ax=list(panels[1]), shrink=0.75, label="cosine distance of the gains")
    return figure


def contact_colors(contact: ContactPosterior) -> Float[Tensor, "points 3"]:
    """Return colors, 0 to 1, dark purple for a thousandth of the greatest probability and less, up to yellow."""
    likely = contact.probability.double()
    share = likely / likely.max().clamp_min(torch.finfo(torch.float64).tiny)
    level = 1.0 + torch.log10(share.clamp_min(10.0**-_DECADES)) / _DECADES
    return _heat(level)


def _heat(level: Float[Tensor, " points"]) -> Float[Tensor, "points 3"]:
    return torch.from_numpy(colormaps[SEQUENTIAL](level.clamp(0.0, 1.0).numpy())[:, :3]).float()


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
