"""The style of every figure: sizes, and colors that color-blind people tell apart.

Series have the colors of Okabe and Ito ("Color Universal Design", 2008). Amounts and levels have viridis, which grows
evenly in lightness; signed values have a diverging map from blue to red through white. The studio's page takes the same
colors (`studio/page/colors.js`, `style.css`).
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from cycler import cycler
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442", "#000000")
"""Colors of curves and categories, in their order."""
FIRST, SECOND = SERIES[:2]
SEQUENTIAL = "viridis"
"""Colormap of amounts and levels."""
DIVERGING = "RdBu_r"
"""Colormap of signed values; its middle is zero."""

_Given = ParamSpec("_Given")
_Drawn = TypeVar("_Drawn")


def styled(draw: Callable[_Given, _Drawn]) -> Callable[_Given, _Drawn]:
    """Return a function that draws in this style, whatever matplotlib's settings are."""
    return rc_context(
        {
            "axes.prop_cycle": cycler(color=SERIES),
            "axes.titlesize": 10,
            "axes.labelsize": 10,
            "figure.titlesize": 12,
            "font.size": 10,
            "grid.alpha": 0.25,
            "image.cmap": SEQUENTIAL,
            "legend.fontsize": 9,
            "legend.frameon": False,
            "xtick.labelsize": 9,
            "ytick.labelsize": 9,
        }
    )(draw)


def series_color(number: int) -> str:
    """Return the color of a series, counted from 0; they repeat."""
    return SERIES[number % len(SERIES)]


def titled_figure(title: str, width: float | int, height: float | int) -> Figure:
    """Return an empty figure of this size, inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title)
    return figure


def scatter_surface(
    axes: Axes, seen: Float[np.ndarray, "points 3"], colors: np.ndarray, *, inches: float, **settings: Any
) -> PathCollection:
    """Draw points of a surface as dots that close to it: columns of `seen` are right, up and towards the eye.

    Dots are about twice as wide as they lie apart where the object fills `inches`, and near ones hide far ones.
    """
    wide, high = np.ptp(seen[:, :2], axis=0)
    slender = max(wide, high) / max(min(wide, high), 0.05 * max(wide, high), 1e-30)
    dot = 72 * inches * 2.4 / np.sqrt(max(len(seen) * slender, 400))
    order = np.argsort(seen[:, 2])
    across, along = seen[order, 0], seen[order, 1]
    axes.set_aspect("equal")
    return axes.scatter(across, along, c=colors[order], s=dot**2, linewidths=0, rasterized=True, **settings)
