"""Figures of edits: where their modes lie among labelled objects, and their CLAP score over the steps."""

from collections.abc import Mapping, Sequence
from statistics import mean
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avmsf.plotting.style import series_color, styled

Move: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Where an edited object's modes lie in an embedding before and after the edit."""
Curve: TypeAlias = Sequence[tuple[int, float]]
"""Steps of an edit and its CLAP score after each; step 0 is the object as it was."""
_PANEL = 4.2
"""Inches."""


@styled
def draw_embedding(
    points: Float[np.ndarray, "objects 2"],
    materials: Sequence[str],
    moves: Mapping[str, Sequence[Move]],
    *,
    target: str,
    title: str,
) -> Figure:
    """Draw labelled objects in an embedding of their modes, and arrows from edited objects before to after the edit.

    One panel for each method of `moves`. A star marks the mean of the objects of the material `target`, from which the
    UMAP distance is measured.
    """
    figure = Figure(figsize=(_PANEL * len(moves) + 1.6, _PANEL + 0.6), layout="constrained")
    panels = figure.subplots(1, len(moves), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (method, changes) in zip(panels, moves.items(), strict=True):
        _draw_objects(axes, points, materials)
        center = points[[material == target for material in materials]].mean(axis=0)
        axes.plot(*center, "*", color="black", markersize=13, label=f"mean of {target}")
        for before, after in changes:
            axes.annotate(
                "", after, before, arrowprops={"arrowstyle": "->", "color": "0.3", "shrinkA": 0, "shrinkB": 0}
            )
        ends = np.asarray(changes, dtype=float).reshape(-1, 2, 2)
        axes.plot(*ends[:, 0].T, "o", mfc="white", color="black", markersize=6, label="before the edit")
        axes.plot(*ends[:, 1].T, "D", color="black", markersize=5, label="after the edit")
        axes.set_title(method)
        axes.set_xlabel("UMAP 1")
    panels[0].set_ylabel("UMAP 2")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    figure.suptitle(title)
    return figure


@styled
def draw_clap_curves(curves: Mapping[str, Sequence[Curve]], *, title: str) -> Figure:
    """Draw the CLAP score over the steps: a thin line for each edit, a thick one for the mean of each method.

    The mean is taken at the steps that all edits of the method have.
    """
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for number, (method, edits) in enumerate(curves.items()):
        color = series_color(number)
        for edit in edits:
            axes.plot(*zip(*edit, strict=True), color=color, linewidth=0.7, alpha=0.4)
        steps = sorted(set.intersection(*(set(dict(edit)) for edit in edits)))
        means = [mean(dict(edit)[step] for edit in edits) for step in steps]
        axes.plot(steps, means, "o-", color=color, linewidth=2.2, markersize=4, label=f"{method}, {len(edits)} edits")
    axes.set_xlabel("step")
    axes.set_ylabel("CLAP score")
    axes.grid()
    axes.legend()
    figure.suptitle(title)
    return figure


def _draw_objects(axes: Axes, points: Float[np.ndarray, "objects 2"], materials: Sequence[str]) -> None:
    for number, material in enumerate(sorted(set(materials))):
        own = points[[each == material for each in materials]]
        axes.scatter(own[:, 0], own[:, 1], s=36, alpha=0.75, color=series_color(number), label=material)
