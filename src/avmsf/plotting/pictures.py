"""Pictures of modes, gains and scores: functions from values to a matplotlib figure, and one that writes it."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank
from avmsf.plotting.style import DIVERGING, FIRST, SECOND, styled

FORMATS = ("png", "pdf", "svg")


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure as its file's ending says. Raises EvaluationError for another ending than png, pdf or svg."""
    ending = expect_format(path)
    memory = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(memory, format=ending, dpi=150)
    write_whole(path, lambda place: place.write_bytes(memory.getvalue()))


def expect_format(path: Path) -> str:
    """Return the format that a picture's file name asks for; raises as `save_picture`."""
    ending = path.suffix.lower().lstrip(".")
    if ending not in FORMATS:
        raise EvaluationError.expected(
            "a name that ends in .png, .pdf or .svg", path.suffix, got=str(path.suffix or "no ending"), file=path
        )
    return ending


@styled
def draw_modes(
    bank: ModalBank, level_db: Float[Tensor, " modes"], *, title: str, is_mode: Bool[Tensor, " modes"] | None = None
) -> Figure:
    """Draw each mode's level (dB) and decay time (T60, s) over its frequency (logarithmic) as stems.

    Those of most energy are labelled. Supporting poles, which are no modes, are gray.
    """
    figure = Figure(figsize=(9, 5.4), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    frequency, level = bank.frequency.numpy(), level_db.numpy()
    bottom = 10.0 * math.floor(float(level.min()) / 10) - 5.0
    kept = np.ones(len(level), dtype=bool) if is_mode is None else is_mode.numpy()
    t60 = math.log(1000) / bank.damping.numpy()
    for axes, heights, foot, own in ((upper, level, bottom, FIRST), (lower, t60, 0.0, SECOND)):
        for rows, color in ((~kept, "lightgray"), (kept, own)):
            if rows.any():
                _stems(axes, frequency[rows], heights[rows], bottom=foot, color=color)
    upper.set_ylim(bottom, float(level.max()) + 0.12 * (float(level.max()) - bottom))
    upper.set_ylabel("level (dB re strongest pole)")
    for row in _apart(frequency, np.where(kept, level + 10 * np.log10(t60), -np.inf), most=8):
        place = (frequency[row], level[row])
        upper.annotate(
            f"{frequency[row]:.4g}", place, xytext=(0, 5), textcoords="offset points", ha="center", fontsize=8
        )
    lower.set_ylim(bottom=0.0)
    lower.set_ylabel("decay time T60 (s)")
    lower.set_xlabel("frequency (Hz)")
    lower.set_xscale("log")
    lower.set_xlim(0.9 * float(frequency.min()), 1.1 * float(frequency.max()))
    lower.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    for axes in (upper, lower):
        axes.grid()
    figure.suptitle(title)
    return figure


@styled
def draw_gains(
    points: Float[Tensor, "points 3"],
    gains: Float[Tensor, "points modes"],
    bank: ModalBank,
    *,
    title: str,
    contacts: Float[Tensor, "contacts 3"] | None = None,
    most: int = 6,
) -> Figure:
    """Draw the signed gains of the modes of most energy on the object's points (object frame), each on its own scale.

    `contacts` are marked by crosses. An object that is flat along an axis is drawn in its plane.
    """
    frequency = bank.frequency
    strongest = torch.argsort(gains.square().mean(0) / bank.damping, descending=True)[:most]
    columns = min(3, len(strongest))
    rows = math.ceil(len(strongest) / columns)
    places = points.double().numpy()
    extent = np.ptp(places, axis=0)
    wide = [axis for axis in range(3) if extent[axis] > 1e-3 * extent.max()]
    height = float(np.clip(3.2 * extent[wide[1]] / extent[wide[0]] + 0.8, 1.6, 5.0)) if len(wide) == 2 else 3.7
    figure = Figure(figsize=(4.4 * columns, height * rows + 0.5), layout="constrained")
    marks = None if contacts is None else contacts.double().numpy()
    for number, mode in enumerate(sorted(strongest.tolist(), key=lambda mode: float(frequency[mode]))):
        values = gains[:, mode].numpy()
        colors = {"c": values, "cmap": DIVERGING, "vmin": -np.abs(values).max(), "vmax": np.abs(values).max()}
        place = (rows, columns, number + 1)
        if len(wide) == 2:
            axes, drawn = _scatter_in_plane(figure, place, places, marks, wide, colors)
        else:
            axes, drawn = _scatter_in_space(figure, place, places, marks, colors)
        axes.set_title(f"{float(frequency[mode]):.4g} Hz")
        figure.colorbar(
            drawn, ax=axes, shrink=0.8 if len(wide) == 2 else 0.6, pad=0.02 if len(wide) == 2 else 0.16
        ).ax.tick_params(labelsize=8)
    figure.suptitle(f"{title}\n(color: signed gain, in the unit of the recordings)")
    return figure


def _stems(axes: Axes, places: np.ndarray, heights: np.ndarray, *, bottom: float, color: str) -> None:
    marks, lines, base = axes.stem(places, heights, bottom=bottom)
    marks.set(color=color, markersize=4)
    lines.set(color=color, linewidth=1)
    base.set_visible(False)


def _apart(frequency: np.ndarray, energy: np.ndarray, *, most: int) -> list[int]:
    """Return the modes of most energy whose labels do not run into one another."""
    chosen: list[int] = []
    places = np.log(frequency)
    for row in np.argsort(-energy)[: np.isfinite(energy).sum()].tolist():
        if len(chosen) < most and all(abs(places[row] - places[one]) > 0.05 * np.ptp(places) for one in chosen):
            chosen.append(row)
    return chosen


def _scatter_in_plane(
    figure: Figure,
    place: tuple[int, int, int],
    points: np.ndarray,
    marks: np.ndarray | None,
    wide: Sequence[int],
    colors: dict[str, Any],
) -> tuple[Any, Any]:
    axes = figure.add_subplot(*place)
    across, along = (points[:, axis] for axis in wide)
    # Dots about twice as wide as their distance, if they fill the picture's 3 inches, so that they close to a surface.
    size = 216 * 2.2 / np.sqrt(len(points) * np.ptp(across) / np.ptp(along))
    drawn = axes.scatter(across, along, s=size**2, marker="s", linewidths=0, rasterized=True, **colors)
    if marks is not None:
        axes.plot(marks[:, wide[0]], marks[:, wide[1]], "kx", markersize=5)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[wide[0]]} (m)")
    axes.set_ylabel(f"{'xyz'[wide[1]]} (m)")
    return axes, drawn


def _scatter_in_space(
    figure: Figure, place: tuple[int, int, int], points: np.ndarray, marks: np.ndarray | None, colors: dict
) -> tuple[Any, Any]:
    axes = figure.add_subplot(*place, projection="3d")
    drawn = axes.scatter(points[:, 0], points[:, 1], points[:, 2], s=4, linewidths=0, rasterized=True, **colors)
    if marks is not None:
        axes.scatter(marks[:, 0], marks[:, 1], marks[:, 2], c="black", marker="x", s=20, depthshade=False)
    axes.set_box_aspect(np.maximum(np.ptp(points, axis=0), 0.15 * np.ptp(points, axis=0).max()), zoom=1.3)
    axes.view_init(elev=38, azim=-60)
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y"), (axes.zaxis, "z")):
        axis.set_label_text(f"{name} (m)")
        axis.set_major_locator(MaxNLocator(3))
        axis.set_tick_params(labelsize=7)
    return axes, drawn
