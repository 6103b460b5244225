"""Pictures of predictive uncertainty: which sides show a contact, and how many sides there are."""

import pytest
import torch
from matplotlib.figure import Figure

from avmsf.field.posterior import relative_gain_std, spectrum_band
from avmsf.plotting.uncertainty import draw_band, draw_uncertainty
from factories.believing_field import bar_contacts, bar_points, drawn_gains, elastic_field, sound_field


def test_pictures_are_drawn_of_solids_and_of_sheets() -> None:
    contacts = bar_contacts(8)
    field = sound_field(elastic_field(contacts, drawn_gains(contacts, seed=9)))
    points = bar_points()
    std = relative_gain_std(field, points)
    sheet = draw_uncertainty(points, std, title="bar", contacts=contacts, suggested=contacts[:2])
    assert len(sheet.axes) == 2  # the sheet and its colors
    bent = points + torch.tensor([0.0, 0.0, 1.0]) * points[:, :1].square()
    solid = draw_uncertainty(bent, std, title="bent", suggested=contacts[:3])
    assert len(solid.axes) == 7
    band = draw_band(spectrum_band(field, contacts[0]), title="one impact")
    assert band.axes[0].get_xlim() == (0.0, pytest.approx(1000.0, abs=5.0))


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
