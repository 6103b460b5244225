"""The paper's figures of edits: `python -m benchmarks.editingfigures RECORD FOLDER`.

RECORD is the JSON file that `python -m benchmarks.editingprotocol --record` writes; nothing is edited again. For each
space and each transition of materials, `umap-SPACE-SOURCE-to-TARGET.png` shows all labelled objects, and the edited
ones before and after, by every method; `clap.png` shows the CLAP score over the steps, if the record has any.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from avmsf._utils.text import read_json
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.plotting.edits import draw_clap_curves
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.style import series_color, styled, titled_figure

BEFORE = "before"
"""Method of the protocol that leaves an object as it was."""
_SAME = ("object", "source", "target", "prompt", "seed")
"""What scores of one task have in common."""
Move: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Where an edited object's modes lie in an embedding before and after the edit."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw, and name the files; return 0, or 2 for a file that is no record."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.editingfigures", description=__doc__)
    parser.add_argument("record", type=Path, help="JSON file of python -m benchmarks.editingprotocol --record")
    parser.add_argument("folder", type=Path, help="folder for the figures")
    chosen = parser.parse_args(arguments)
    try:
        paths = write_figures(chosen.record, chosen.folder)
    except AvmsfError as error:
        print(f"benchmarks.editingfigures: {error}", file=sys.stderr)
        return 2
    for path in paths:
        print(f"wrote {path}")
    return 0


def write_figures(record: Path, folder: Path) -> list[Path]:
    """Draw all figures of a record and return their files. Raises EvaluationError for a file that is no record."""
    try:
        read = read_json(record)
        scores, spaces = read["scores"], read["spaces"]
        figures = {
            f"umap-{name}-{source}-to-{target}.png": draw_embedding(
                np.array(space["embedding"], dtype=float),
                space["materials"],
                _moves([each for each in scores if (each["source"], each["target"]) == (source, target)], name),
                target=target,
                title=f"{source} to {target}, UMAP of {len(space['names'])} objects ({space['features']})",
            )
            for name, space in spaces.items()
            for source, target in dict.fromkeys((each["source"], each["target"]) for each in scores)
        }
        curves: dict[str, list[list[tuple[int, float]]]] = {}
        for each in scores:
            if each["clap_curve"]:
                curves.setdefault(each["method"], []).append([(step, score) for step, score in each["clap_curve"]])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise EvaluationError(
            f"{record}: expected a record of python -m benchmarks.editingprotocol --record, got "
            f"{type(error).__name__}: {error}; run the protocol again",
            file=record,
        ) from error
    if curves:
        figures["clap.png"] = draw_clap_curves(curves, title="CLAP score of the previews and the prompt")
    for file, figure in figures.items():
        save_picture(figure, folder / file)
    return [folder / file for file in figures]


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
    return figure


def _moves(scores: Sequence[Mapping[str, Any]], space: str) -> dict[str, list[Move]]:
    """Return where each method moved the objects of one transition."""
    before = {_task(each): _place(each, space) for each in scores if each["method"] == BEFORE}
    methods = dict.fromkeys(each["method"] for each in scores if each["method"] != BEFORE)
    return {
        method: [
            (before[_task(each)], _place(each, space))
            for each in scores
            if each["method"] == method and _task(each) in before
        ]
        for method in methods
    }


def _place(score: Mapping[str, Any], space: str) -> tuple[float, float]:
    first, second = score["places"][space]
    return first, second


def _task(score: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(score[name] for name in _SAME)


if __name__ == "__main__":
    sys.exit(main())
