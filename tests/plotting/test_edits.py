"""Figures of edits: the places of objects, arrows and curves are read back from the figure."""

import numpy as np
import pytest
from matplotlib.text import Annotation

from avmsf.plotting.edits import draw_clap_curves
from benchmarks.editingfigures import draw_embedding

POINTS = np.array([[0.0, 0.0], [1.0, 0.0], [5.0, 5.0], [5.0, 7.0]])
MATERIALS = ("wood", "wood", "glass", "glass")


def test_objects_and_edits_are_drawn_at_their_places() -> None:
    moves = {"ours": [((0.5, 0.0), (4.0, 4.0)), ((1.0, 1.0), (5.0, 6.5))], "other": [((0.5, 0.0), (0.0, 1.0))]}
    figure = draw_embedding(POINTS, MATERIALS, moves, target="glass", title="wood to glass")
    assert [axes.get_title() for axes in figure.axes] == ["ours", "other"]
    for axes in figure.axes:
        assert {each.get_label(): np.asarray(each.get_offsets()).tolist() for each in axes.collections} == {
            "glass": POINTS[2:].tolist(),
            "wood": POINTS[:2].tolist(),
        }
        changes = moves[axes.get_title()]
        lines = {str(line.get_label()): np.asarray(line.get_xydata()).tolist() for line in axes.lines}
        assert lines["before the edit"] == [list(before) for before, _ in changes]
        assert lines["after the edit"] == [list(after) for _, after in changes]
        # The UMAP distance is measured from here.
        assert lines["mean of glass"] == [[5.0, 6.0]]
        arrows = [text for text in axes.texts if isinstance(text, Annotation)]
        assert [(each.xyann, each.xy) for each in arrows] == changes


def test_curves_have_a_line_for_each_edit_and_the_mean_of_each_method() -> None:
    curves = {"ours": [[(0, 0.1), (10, 0.3)], [(0, 0.2), (5, 0.9), (10, 0.4)]], "other": [[(0, 0.1), (10, 0.0)]]}
    (axes,) = draw_clap_curves(curves, title="CLAP").axes
    drawn = [(str(line.get_label()), np.asarray(line.get_xydata()).tolist()) for line in axes.lines]
    edits = [points for label, points in drawn if label.startswith("_")]
    assert edits == [[list(point) for point in edit] for method in curves.values() for edit in method]
    means = {label: points for label, points in drawn if not label.startswith("_")}
    assert list(means) == ["ours, 2 edits", "other, 1 edits"]
    # Step 5 is not of all edits.
    assert np.array(means["ours, 2 edits"]) == pytest.approx(np.array([[0, 0.15], [10, 0.35]]))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("step", "CLAP score")
