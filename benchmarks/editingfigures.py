"""The paper's figures of edits: objects in the embedding before and after, and CLAP scores over the steps."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from avmsf.plotting.edits import draw_clap_curves
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.style import series_color, styled, titled_figure
from benchmarks.editing import UNTOUCHED, EditScore
from benchmarks.mode_embedding import MaterialSpace

Move: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Where an edited object's modes lie in an embedding before and after the edit."""


def write_figures(scores: Sequence[EditScore], spaces: Mapping[str, MaterialSpace], folder: Path) -> None:
    """Draw `umap-SPACE-SOURCE-to-TARGET.png` for each space and transition, and `clap.png` if scores have curves."""
    for name, space in spaces.items():
        for source, target in dict.fromkeys((each.source, each.target) for each in scores):
            moves = _moves([each for each in scores if (each.source, each.target) == (source, target)], name)
            title = f"{source} to {target}, UMAP of {len(space.names)} objects ({space.features})"
            figure = draw_embedding(space.embedding, space.materials, moves, target=target, title=title)
            save_picture(figure, folder / f"umap-{name}-{source}-to-{target}.png")
    curves: dict[str, list[Sequence[tuple[int, float]]]] = {}
    for each in scores:
        if each.clap_curve:
            curves.setdefault(each.method, []).append(each.clap_curve)
    if curves:
        figure = draw_clap_curves(curves, title="CLAP score of the previews and the prompt")
        save_picture(figure, folder / "clap.png")


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
    figure = titled_figure(title, 4.2 * len(moves) + 1.6, 4.8)
    panels = figure.subplots(1, len(moves), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (method, changes) in zip(panels, moves.items(), strict=True):
        for number, material in enumerate(sorted(set(materials))):
            own = points[[each == material for each in materials]]
            axes.scatter(own[:, 0], own[:, 1], s=36, alpha=0.75, color=series_color(number), label=material)
        center = points[[material == target for material in materials]].mean(axis=0)
        axes.plot(*center, "*", color="black", markersize=13, label=f"mean of {target}")
        arrow = {"arrowstyle": "->", "color": "0.3", "shrinkA": 0, "shrinkB": 0}
        for before, after in changes:
            axes.annotate("", after, before, arrowprops=arrow)
        ends = np.asarray(changes, dtype=float).reshape(-1, 2, 2)
        axes.plot(*ends[:, 0].T, "o", mfc="white", color="black", markersize=6, label="before the edit")
        axes.plot(*ends[:, 1].T, "D", color="black", markersize=5, label="after the edit")
        axes.set_title(method)
        axes.set_xlabel("UMAP 1")
    panels[0].set_ylabel("UMAP 2")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    return figure


def _moves(scores: Sequence[EditScore], space: str) -> dict[str, list[Move]]:
    """Return where each method moved the objects of one transition."""

    def task(score: EditScore) -> tuple[str, str | None, int]:
        return score.object, score.prompt, score.seed

    before = {task(each): each.places[space] for each in scores if each.method == UNTOUCHED.name}
    moves: dict[str, list[Move]] = {each.method: [] for each in scores if each.method != UNTOUCHED.name}
    for each in scores:
        if each.method in moves and task(each) in before:
            moves[each.method].append((before[task(each)], each.places[space]))
    return moves
