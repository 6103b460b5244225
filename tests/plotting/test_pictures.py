"""Pictures show what they are given: positions, levels, scales and units are read back from the figures."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection

from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank
from avmsf.plotting.pictures import draw_gains, draw_modes, save_picture
from factories.raising import raises

BANK = ModalBank(
    torch.tensor([200.0, 1000.0, 1010.0], dtype=torch.float64), torch.tensor([2.0, 10.0, 20.0], dtype=torch.float64)
)


def test_stems_stand_at_the_modes_as_high_as_their_levels_and_decay_times() -> None:
    figure = draw_modes(BANK, torch.tensor([-12.0, 0.0, -31.0]), title="a bowl")
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
    figure = draw_gains(points, gains, BANK, title="a bowl", most=2)
    drawn = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in drawn] == ["200 Hz", "1010 Hz"]
    for axes, mode in zip(drawn, (0, 2), strict=True):
        values = axes.collections[0]
        assert np.array_equal(values.get_array(), gains[:, mode].numpy())
        assert values.get_clim() == pytest.approx(
            (-float(gains[:, mode].abs().max()), float(gains[:, mode].abs().max()))
        )
        assert axes.get_zlabel() == "z (m)"


def test_a_flat_object_is_drawn_in_its_plane_with_crosses_at_the_contacts() -> None:
    points = torch.cartesian_prod(torch.linspace(0, 0.3, 9), torch.zeros(1), torch.linspace(0, 0.1, 5))
    contacts = points[[3, 7]]
    one = ModalBank(BANK.frequency[:1], BANK.damping[:1])
    figure = draw_gains(points, torch.ones(45, 1), one, title="a plate", contacts=contacts)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    (crosses,) = axes.lines
    assert np.allclose(np.c_[crosses.get_xdata(), crosses.get_ydata()], contacts[:, [0, 2]].numpy())


def test_a_picture_has_the_format_that_its_name_says(tmp_path: Path) -> None:
    figure = draw_modes(BANK, torch.zeros(3), title="a bowl")
    for name, start in (("a.png", b"\x89PNG"), ("a.PDF", b"%PDF"), ("deep/a.svg", b"<?xml")):
        save_picture(figure, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with raises(EvaluationError, value=".jpeg"):
        save_picture(figure, tmp_path / "a.jpeg")
