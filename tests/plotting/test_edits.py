"""Figures of edits: curves are read back from the figure."""

import numpy as np
import pytest

from avmsf.plotting.edits import draw_clap_curves


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
