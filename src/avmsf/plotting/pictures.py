"""Pictures of modes and gains, and a function that writes a figure."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank
from avmsf.plotting.clouds import name_axes, plane_of, view_from
from avmsf.plotting.style import DIVERGING, FIRST, SECOND, scatter_surface, styled, titled_figure

_SIDE = (-60.0, 38.0)
"""From where gains are seen: a little above, into what is open there."""


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure as its file's ending says. Raises EvaluationError for another ending than png, pdf or svg."""
    ending = path.suffix.lower().lstrip(".")
    if ending not in ("png", "pdf", "svg"):
        got = path.suffix or "no ending"
        raise EvaluationError.expected("a name that ends in .png, .pdf or .svg", path.suffix, got=got, file=path)
    memory = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(memory, format=ending, dpi=150)
    write_whole(path, memory.getvalue())


@styled
def draw_modes(
    bank: ModalBank, level_db: Float[Tensor, " modes"], *, title: str, is_mode: Bool[Tensor, " modes"] | None = None
) -> Figure:
    """Draw each mode's level (dB) and decay time (T60, s) over its frequency (logarithmic) as stems.

    Those of most energy are labelled. Supporting poles, which are no modes, are gray.
    """
    figure = titled_figure(title, 9, 5.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    frequency, level = bank.frequency.numpy(), level_db.numpy()
    bottom = 10.0 * math.floor(float(level.min()) / 10) - 5.0
    kept = np.ones(len(level), dtype=bool) if is_mode is None else is_mode.numpy()
    t60 = bank.t60.numpy()
    for axes, heights, foot, own in ((upper, level, bottom, FIRST), (lower, t60, 0.0, SECOND)):
        for rows, color in ((~kept, "lightgray"), (kept, own)):
            if rows.any():
                marks, lines, base = axes.stem(frequency[rows], heights[rows], bottom=foot)
                marks.set(color=color, markersize=4)
                lines.set(color=color, linewidth=1)
                base.set_visible(False)
    top = float(level.max()) + 0.12 * (float(level.max()) - bottom)
    upper.set(ylim=(bottom, top), ylabel="level (dB re strongest pole)")
    for row in _apart(frequency, np.where(kept, level + 10 * np.log10(t60), -np.inf), most=8):
        offset: dict[str, Any] = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center"}
        upper.annotate(f"{frequency[row]:.4g}", (frequency[row], level[row]), fontsize=8, **offset)
    lower.set_ylim(bottom=0.0)
    lower.set(xscale="log", xlabel="frequency (Hz)", ylabel="decay time T60 (s)")
    lower.set_xlim(0.9 * float(frequency.min()), 1.1 * float(frequency.max()))
    lower.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    for axes in (upper, lower):
        axes.grid()
    return figure


@styled
def draw_gains(
    points: Float[Tensor, "points 3"],
    gains: Float[Tensor, "points modes"],
    bank: ModalBank,
    *,
    title: str,
    most: int = 6,
) -> Figure:
    """Draw the signed gains of the modes of most energy on the object's points (object frame), each on its own scale.

    An object that is flat along an axis is drawn in its plane, any other from one side.
    """
    frequency = bank.frequency
    strongest = torch.argsort(gains.square().mean(0) / bank.damping, descending=True)[:most]
    columns = min(3, len(strongest))
    rows = math.ceil(len(strongest) / columns)
    places, plane = points.double().numpy(), plane_of(points.double().numpy())
    view = view_from(_SIDE) if plane is None else plane
    seen = places @ view.T
    wide, high, _ = np.ptp(seen, axis=0)
    height = float(np.clip(3.2 * high / wide + 0.8, 1.6, 5.0))
    figure = titled_figure(
        f"{title}\n(color: signed gain, in the unit of the recordings)", 4.4 * columns, height * rows + 0.5
    )
    for number, mode in enumerate(sorted(strongest.tolist(), key=lambda mode: float(frequency[mode]))):
        values = gains[:, mode].numpy()
        scale = {"cmap": DIVERGING, "vmin": -np.abs(values).max(), "vmax": np.abs(values).max()}
        axes = figure.add_subplot(rows, columns, number + 1)
        drawn = scatter_surface(axes, seen, values, inches=3.0, **scale)
        if plane is None:
            name_axes(axes, view)
        else:
            across, along = ("xyz"[int(row.argmax())] for row in plane[:2])
            axes.set(xlabel=f"{across} (m)", ylabel=f"{along} (m)")
        axes.set_title(f"{float(frequency[mode]):.4g} Hz")
        figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.02).ax.tick_params(labelsize=8)
    return figure


def _apart(frequency: np.ndarray, energy: np.ndarray, *, most: int) -> list[int]:
    """Return the modes of most energy whose labels do not run into one another."""
    chosen: list[int] = []
    places = np.log(frequency)
    for row in np.argsort(-energy)[: np.isfinite(energy).sum()].tolist():
        if len(chosen) < most and all(abs(places[row] - places[one]) > 0.05 * np.ptp(places) for one in chosen):
            chosen.append(row)
    return chosen
