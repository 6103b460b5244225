"""Blows from opposite sides of a thin wall."""

import torch

from avmsf.field.gains.data import orientation_signs


def _row(count: int) -> torch.Tensor:
    return torch.tensor([[0.01 * place, 0.0, 0.0] for place in range(count)], dtype=torch.float64)


def test_a_blow_from_the_other_side_of_a_wall_turns_its_sign():
    directions = torch.tensor([[0.0, 0.0, -1.0]] * 6)
    directions[2] = -directions[2]
    assert orientation_signs(_row(6), directions).tolist() == [1, 1, -1, 1, 1, 1]


def test_around_a_closed_object_directions_turn_gradually_and_no_sign_does():
    angles = torch.linspace(0, 2 * torch.pi, 13)[:-1]
    places = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    assert orientation_signs(places.double(), -places).tolist() == [1] * 12


def test_all_directions_turned_change_nothing():
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(9, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(9, 3, generator=generator), dim=1)
    assert torch.equal(orientation_signs(places, directions), orientation_signs(places, -directions))


def test_two_blows_at_one_place_from_both_sides():
    places = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [0.1, 0, 0]])
    directions = torch.tensor([[0.0, 0, 1], [0.0, 0, -1], [0.0, 0, 1]])
    signs = orientation_signs(places, directions)
    assert signs[0] == -signs[1] == signs[2] == 1


def test_unknown_directions_turn_nothing():
    assert orientation_signs(_row(4), None).tolist() == [1, 1, 1, 1]
