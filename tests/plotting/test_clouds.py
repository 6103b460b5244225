"""Pictures of clouds show what they are given, where it is."""

import numpy as np
import pytest
import torch

from avmsf.errors import EvaluationError
from avmsf.plotting.clouds import ALL_SIDES, AROUND, component_colors, draw_cloud, view_from
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.raising import raises

GENERATOR = torch.Generator().manual_seed(0)
POINTS = torch.rand(300, 3, generator=GENERATOR) * torch.tensor([0.2, 0.1, 0.3])
FOUND = Symmetries(
    (RotationalSymmetry(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([0.1, 0.05, 0.0]).double(), 4, 0.1),),
    (MirrorSymmetry(torch.tensor([1.0, 0.0, 0.0]).double(), torch.tensor([0.1, 0.0, 0.0]).double(), 0.1),),
    0.01,
    0.35,
    1.0,
)


def test_a_sheet_has_a_row_for_each_set_of_colors_and_a_column_for_each_side():
    rows = {"color": torch.rand(300, 3), "features": component_colors(torch.randn(300, 8, generator=GENERATOR))}
    figure = draw_cloud(POINTS, rows, title="a box", symmetries=FOUND, sides=((0.0, 25.0), (90.0, 25.0)))
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [
        f"{name}\nazimuth {azimuth}°, elevation 25°"
        for name in ("color", "features", "symmetries")
        for azimuth in (0, 90)
    ]
    assert all(len(axes.collections[0].get_offsets()) == 300 for axes in figure.axes)
    assert [len(axes.lines) for axes in figure.axes] == [0] * 4 + [2, 2]


def test_an_axis_and_a_plane_are_drawn_where_they_are():
    figure = draw_cloud(POINTS, {}, title="a box", symmetries=FOUND, sides=((90.0, 25.0),))
    plane, axis = figure.axes[0].lines
    # Seen from y, with z up, the upright axis is upright; and the plane, whose normal is x, is seen edge-on. The
    # cloud's middle is a few thousandths from that of the box.
    assert np.ptp(axis.get_xdata()) < 1e-12
    assert np.abs(axis.get_xdata()).max() < 0.005
    assert np.ptp(axis.get_ydata()) == pytest.approx(2.1 * np.cos(np.radians(25)) * 0.187, rel=0.05)
    assert abs(np.mean(axis.get_ydata())) < 0.005
    assert np.abs(plane.get_xdata()).max() < 0.005
    # Seen from y, x lies to the left and z up, y at the eye.
    order, *named = figure.axes[0].texts
    assert order.get_text() == "4"
    across = {text.get_text(): text.xyann for text in named}
    assert across.keys() == {"x", "y", "z"}
    assert across["x"][0] < -20
    assert across["z"][1] > 20


def test_no_direction_is_out_of_sight_from_all_sides():
    eyes = np.array([view_from(side)[2] for side in ALL_SIDES])
    faces = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    # Seen at no less than a few degrees.
    assert (faces.numpy() @ eyes.T).max(1).min() > 0.05
    for side in ALL_SIDES:
        view = view_from(side)
        assert np.allclose(view @ view.T, np.eye(3))
        assert np.linalg.det(view) == pytest.approx(1.0)


def test_what_points_up_is_up_and_nearer_points_come_last():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 0.0]])
    colors = torch.eye(3)
    axes = draw_cloud(points, {"color": colors}, title="", sides=((90.0, 25.0),), up=(0.0, 1.0, 0.0)).axes[0]
    drawn = axes.collections[0]
    place = {
        int(np.argmax(face[:3])): spot for face, spot in zip(drawn.get_facecolors(), drawn.get_offsets(), strict=True)
    }
    assert place[1][1] - place[0][1] == pytest.approx(np.cos(np.radians(25)))
    # With y up the camera begins at z and goes towards x, where the third point is: nearest, drawn last but for the
    # second, which lies above and so nearer to a camera that looks down on it.
    order = [int(np.argmax(face[:3])) for face in drawn.get_facecolors()]
    assert order == [0, 1, 2]


def test_colors_follow_the_principal_components():
    value = torch.linspace(-1, 1, 101)
    features = torch.stack([3 * value, torch.cos(20 * value), torch.zeros(101)], dim=1)
    colors = component_colors(features)
    assert bool((colors[:, 0].diff() >= 0).all())
    assert float(colors.min()) == 0.0
    assert float(colors.max()) == 1.0
    # Two components fill two colors; the third stays gray.
    assert bool((colors[:, 2] == 0.5).all())
    assert bool((component_colors(torch.ones(9, 4)) == 0.5).all())


def test_what_cannot_be_drawn_is_refused():
    with raises(EvaluationError, value=(len(POINTS), 0, len(AROUND))):
        draw_cloud(POINTS, {}, title="")
    with raises(EvaluationError, name="up", value=[0.0, 0.0, 0.0]):
        draw_cloud(POINTS, {"color": POINTS}, title="", up=(0.0, 0.0, 0.0))
