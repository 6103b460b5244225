"""Pictures show what they are given: positions, levels, scales, colors and units are read back from the figures."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from avmsf.errors import EvaluationError
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.plotting.edits import draw_clap_curves
from avmsf.plotting.objects import ALL_SIDES, component_colors, draw_cloud, view_from
from avmsf.plotting.pictures import draw_gains, draw_modes, draw_spectrograms, log_spectrogram, save_picture
from avmsf.plotting.style import FIRST, SECOND
from avmsf.plotting.uncertainty import contact_colors, draw_contact, draw_uncertainty
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.made_fields import BANK, positional, sounding
from factories.raising import raises

MODES = ModalBank(
    torch.tensor([200.0, 1000.0, 1010.0], dtype=torch.float64), torch.tensor([2.0, 10.0, 20.0], dtype=torch.float64)
)


def test_stems_stand_at_the_modes_as_high_as_their_levels_and_decay_times() -> None:
    figure = draw_modes(MODES, torch.tensor([-12.0, 0.0, -31.0]), title="a bowl")
    upper, lower = figure.axes
    for axes, heights in ((upper, [-12.0, 0.0, -31.0]), (lower, [math.log(1000) / d for d in (2.0, 10.0, 20.0)])):
        (stems,) = (drawn for drawn in axes.collections if isinstance(drawn, LineCollection))
        assert np.allclose([segment[1] for segment in stems.get_segments()], np.c_[[200.0, 1000.0, 1010.0], heights])
    assert figure.get_suptitle() == "a bowl"
    assert upper.get_ylabel() == "level (dB re strongest pole)"
    assert (lower.get_xlabel(), lower.get_ylabel()) == ("frequency (Hz)", "decay time T60 (s)")
    # The doublet's labels would overlap: only the one of more energy is named.
    assert [text.get_text() for text in upper.texts] == ["1000", "200"]


def test_supporting_poles_have_no_label_and_the_modes_of_most_energy_have() -> None:
    frequency = torch.linspace(100.0, 2000.0, 12, dtype=torch.float64)
    damping = torch.full((12,), 1000.0, dtype=torch.float64)
    damping[:3] = 1.0
    is_mode = torch.ones(12, dtype=torch.bool)
    is_mode[[1, 6]] = False
    level = torch.zeros(12)
    level[:2], level[2], level[6] = -10.0, -5.0, 3.0
    figure = draw_modes(ModalBank(frequency, damping), level, is_mode=is_mode, title="a bowl")
    labels = [text.get_text() for text in figure.axes[0].texts]
    assert labels[:2] == [f"{frequency[row]:.4g}" for row in (2, 0)]
    assert not {f"{frequency[row]:.4g}" for row in (1, 6)} & set(labels)
    gray, colored = (drawn for drawn in figure.axes[0].collections if isinstance(drawn, LineCollection))
    assert [len(drawn.get_segments()) for drawn in (gray, colored)] == [2, 10]


def test_gains_are_colored_symmetrically_about_zero_strongest_modes_first_by_frequency() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, 3, generator=generator)
    gains = torch.randn(50, 3, generator=generator) * torch.tensor([1.0, 0.01, 3.0])
    gains[:, 2] = gains[:, 2].abs()
    figure = draw_gains(points, gains, MODES, title="a bowl", most=2)
    drawn = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in drawn] == ["200 Hz", "1010 Hz"]
    for axes, mode in zip(drawn, (0, 2), strict=True):
        values = axes.collections[0]
        # Near points are drawn over far ones.
        assert np.array_equal(np.sort(values.get_array()), np.sort(gains[:, mode].numpy()))
        assert values.get_clim() == pytest.approx(
            (-float(gains[:, mode].abs().max()), float(gains[:, mode].abs().max()))
        )
        assert [text.get_text() for text in axes.texts if text.get_text() in "xyz"]


def test_a_flat_object_is_drawn_in_its_plane() -> None:
    points = torch.cartesian_prod(torch.linspace(0, 0.3, 9), torch.zeros(1), torch.linspace(0, 0.1, 5))
    # Poles without a pitch are no modes.
    none = ModalBank(MODES.frequency[:0], MODES.damping[:0])
    assert draw_gains(points, torch.ones(45, 0), none, title="a thud").axes is not None
    one = ModalBank(MODES.frequency[:1], MODES.damping[:1])
    axes = draw_gains(points, torch.ones(45, 1), one, title="a plate").axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    assert np.allclose(np.unique(axes.collections[0].get_offsets(), axis=0), points[:, [0, 2]].numpy())


def test_a_picture_has_the_format_that_its_name_says(tmp_path: Path) -> None:
    for name, start in (("a.png", b"\x89PNG"), ("a.PDF", b"%PDF"), ("deep/a.svg", b"<?xml")):
        save_picture(Figure(), tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with raises(EvaluationError, value=".jpeg"):
        save_picture(Figure(), tmp_path / "a.jpeg")


GENERATOR = torch.Generator().manual_seed(0)
POINTS = torch.rand(300, 3, generator=GENERATOR) * torch.tensor([0.2, 0.1, 0.3])
TURN = RotationalSymmetry(torch.tensor([0, 0, 1.0]).double(), torch.tensor([0.1, 0.05, 0.0]).double(), 4, 0.1)
MIRROR = MirrorSymmetry(torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.1, 0.0, 0.0]).double(), 0.1)
FOUND = Symmetries((TURN,), (MIRROR,), 0.01, 0.35, 1.0)


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
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.5, 0.0]])
    axes = draw_cloud(points, {"color": torch.eye(3)}, title="", sides=((90.0, 25.0),)).axes[0]
    drawn = axes.collections[0]
    place = {
        int(np.argmax(face[:3])): spot for face, spot in zip(drawn.get_facecolors(), drawn.get_offsets(), strict=True)
    }
    assert place[1][1] - place[0][1] == pytest.approx(np.cos(np.radians(25)))
    # The camera is at y, where the third point is: nearest. The second lies above, nearer to a camera that looks down.
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


SAMPLES = 3000
STRUCK = 68


@cache
def contact() -> ContactPosterior:
    """Return where a plate's field locates its own sound at the point `STRUCK`, with noise 60 dB down."""
    locator = Locator.of(sounding(positional(), noise=1e-3, samples=SAMPLES))
    gains = locator.gains[[STRUCK]].to(torch.complex128)
    (sound,) = synthesize(gains, BANK.frequency, BANK.damping, samples=SAMPLES, sample_rate=8000.0)
    noise = torch.randn(SAMPLES, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return locator.locate((sound + 1e-3 * sound.abs().max() * noise).float())


def test_colors_grow_with_probability() -> None:
    sharper = contact().probability ** 10
    colors = contact_colors(replace(contact(), probability=sharper / sharper.sum()))
    brightness = colors.sum(1)
    assert int(brightness.argmax()) == contact().most_probable == STRUCK
    order = torch.argsort(sharper)
    assert bool((brightness[order].diff() >= -1e-6).all())
    # Viridis begins with a dark purple.
    assert colors[int(brightness.argmin())].tolist() == pytest.approx([0.267, 0.005, 0.329], abs=1e-3)


def test_a_picture_shows_both_maps_and_the_marks() -> None:
    figure = draw_contact(contact(), title="hit.wav", others=contact().points[:2], truth=contact().points[5])
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 12
    assert any("elevation -" in title for title in titles)
    assert "blue: " in figure.get_suptitle()
    assert "red: " in figure.get_suptitle()
    # The plate is flat: from above and from below all marks are seen at their places.
    points = contact().points.double().numpy()
    marks = points[[0, 1, STRUCK, 5]] - (points.min(0) + points.max(0)) / 2
    for axes, side in zip(figure.axes, ALL_SIDES * 2, strict=False):
        if abs(side[1]) == 75.0:
            assert np.allclose(axes.collections[1].get_offsets(), (marks @ view_from(side).T)[:, :2])
            assert [to_hex(each) for each in axes.collections[1].get_edgecolors()] == [*["#ffffff"] * 2, FIRST, SECOND]
    assert "red: " not in draw_contact(contact(), title="hit.wav").get_suptitle()


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


RATE = 44100.0


def tone(hertz: float, *, seconds: float = 1.5, rate: float = RATE) -> torch.Tensor:
    return torch.sin(2 * math.pi * hertz * torch.arange(round(seconds * rate), dtype=torch.float64) / rate)


def test_panels_show_20_hz_to_20_khz_of_the_first_second_with_every_method_in_its_column() -> None:
    sounds = {"recorded": tone(440), "field": tone(880), "knn3": tone(1760)}
    figure = draw_spectrograms(
        {"rim": sounds, "base": {"recorded": tone(220)}}, list(sounds), sample_rate=RATE, title="bowl"
    )
    panels = figure.axes[:6]
    assert [axes.get_title() for axes in panels[:3]] == ["recorded", "field", "knn3"]
    assert [axes.get_ylabel().splitlines()[0] for axes in (panels[0], panels[3])] == ["rim", "base"]
    for axes in panels:
        assert axes.get_yscale() == "log"
        assert axes.get_ylim() == pytest.approx((20.0, 20000.0))
        assert axes.get_xlim() == pytest.approx((0.0, 1.0))
    for axes, hertz in zip(panels[:4], (440, 880, 1760, 220), strict=True):
        (mesh,) = axes.collections
        corners = mesh.get_coordinates()
        levels = mesh.get_array()
        row = int(np.argmax(levels[:, levels.shape[1] // 2]))
        low, high = corners[row, 0, 1], corners[row + 1, 0, 1]
        # The highest bin, 21.5 Hz wide, and a cell of 4.4 %.
        assert low - 22 <= hertz <= high + 22
        # Frames are 4 ms apart.
        assert corners[0, -1, 0] == pytest.approx(1.0, abs=0.005)
    # No method but the recording has a sound at the base.
    assert [len(axes.collections) for axes in panels] == [1, 1, 1, 1, 0, 0]


def test_every_sound_is_scaled_to_a_peak_of_one() -> None:
    sounds = {"recorded": 0.01 * tone(440), "same": 7.0 * tone(440), "silent": 0.0 * tone(440)}
    figure = draw_spectrograms({"rim": sounds}, list(sounds), sample_rate=RATE, title="bowl")
    recorded, same, silent = (axes.collections[0].get_array() for axes in figure.axes[:3])
    assert recorded.max() == 0.0
    assert np.allclose(recorded, same, atol=1e-6)
    assert silent.max() < -80
    # Or all on the scale of the recording.
    figure = draw_spectrograms({"rim": sounds}, ["same", "recorded"], sample_rate=RATE, normalize=False, title="bowl")
    same, recorded = (axes.collections[0].get_array() for axes in figure.axes[:2])
    assert same.max() == 0.0
    assert recorded.max() == pytest.approx(20 * math.log10(0.01 / 7.0), abs=1e-4)


def test_a_full_scale_sine_reads_a_quarter_of_the_fft_size() -> None:
    levels = log_spectrogram(tone(1000 * RATE / 44100), sample_rate=RATE, lowest=20.0, highest=20000.0)
    # A sine between two bins of a Hann window loses at most 1.42 dB.
    assert float(levels.max()) == pytest.approx(20 * math.log10(2048 / 4), abs=1.43)


def test_marks_behind_the_object_are_not_drawn() -> None:
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(3000, 3, generator=generator), dim=1)
    marks = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    picture = draw_uncertainty(ball, torch.ones(3000), title="ball", suggested=marks)
    assert _numbers(picture) == [["1"], ["1"], ["1"], ["1"], ["2"], ["2"]]


def test_marks_on_the_other_side_of_a_wall_are_not_drawn() -> None:
    """Two blows on one place of a thin dish: into it from above, and from below."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 60), torch.linspace(-1, 1, 60), indexing="ij")
    dish = torch.stack([x, y, 0.2 * (x.square() + y.square())], dim=2).reshape(-1, 3)
    marks, ways = torch.zeros(2, 3), torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    picture = draw_uncertainty(dish, torch.ones(3600), title="dish", suggested=marks, directions=ways)
    assert _numbers(picture)[3:] == [["1"], ["2"], ["2"]]


def _numbers(picture: Figure) -> list[list[str]]:
    """Return the numbers that each view shows."""
    return [sorted(each.get_text() for each in axes.texts if each.get_text().isdigit()) for axes in picture.axes[:-1]]


def test_a_suggestion_that_no_side_shows_is_drawn_all_the_same() -> None:
    generator = torch.Generator().manual_seed(0)
    cube = 2 * torch.rand(6000, 3, generator=generator) - 1
    marks, ways = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), torch.tensor([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    for directions in (None, ways):
        shown = _numbers(draw_uncertainty(cube, torch.ones(6000), title="cube", suggested=marks, directions=directions))
        assert sum("1" in side for side in shown) > 1
        assert sum("2" in side for side in shown) == 1
