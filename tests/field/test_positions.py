"""Positions are compared with the body of the gains, where they have one: a reconstruction may have closed a cavity."""

import torch

from avmsf.field.gains.scaled import BodyGains, ScaledGains
from avmsf.field.positions import off_surface, off_surface_gains, points_on_object
from factories.believing_field import LENGTH, bar, bar_points
from factories.made_fields import positional

HEIGHT = 0.05
"""Of a false floor above the bar's sheet, meters: an eighth of the length, more than the tolerance."""


def closed() -> BodyGains:
    """Return gains on the bar's sheet whose points lie on the sheet and on a false floor above it."""
    points = bar_points()
    return BodyGains(torch.cat([points, points + torch.tensor([0.0, 0.0, HEIGHT])]).float(), bar())


def test_a_place_on_a_false_floor_is_off_the_body_by_its_height() -> None:
    above = torch.tensor([[0.2, 0.05, 0.0], [0.2, 0.05, HEIGHT]])
    ((row, distance),) = off_surface(above, closed())
    assert row == 1
    assert abs(distance - HEIGHT) < 1e-6


def test_only_a_body_has_the_gains_of_its_nearest_point() -> None:
    assert off_surface_gains(closed()) != off_surface_gains(positional())
    assert off_surface_gains(ScaledGains(closed(), torch.ones(6, dtype=torch.float64), 2.0)) == off_surface_gains(
        closed()
    )


def test_points_of_the_false_floor_are_no_contacts() -> None:
    assert torch.equal(points_on_object(closed()), bar_points().float())
    # Gains without a body are known at all of their points.
    assert torch.equal(points_on_object(positional()), positional().points)


def test_an_edited_body_is_scaled() -> None:
    large = ScaledGains(closed(), torch.ones(6, dtype=torch.float64), 2.0)
    surface = large.surface
    assert surface is not None
    assert float(surface.vertices[:, 0].max()) == 2.0 * float(torch.tensor(LENGTH))
    assert len(points_on_object(large)) == len(bar_points())
    ((_, distance),) = off_surface(torch.tensor([[0.4, 0.1, 2.0 * HEIGHT]]), large)
    assert abs(distance - 2.0 * HEIGHT) < 1e-6
    assert positional().surface is None
