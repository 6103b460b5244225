"""What gains are fitted to: signs by direction, alignment, and places that are held out."""

import pytest
import torch

from avmsf.capture.impacts import Impacts, rows_by_place
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import held_out
from avmsf.field.gains.data import gain_data, orientation_signs
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.mesh.points import farthest_points
from avmsf.modal.extraction.extract import Extraction, extract_modes
from factories.delayed_plate import ALIGNED, delays, distance, strikes, without_delays
from factories.plate_field import plate_impacts


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


COUNT = 12
FEATURES = FeatureField.from_contacts(strikes(COUNT).contacts)
CONFIG = FitConfig(steps=0, damping="shared")


@pytest.fixture(scope="module")
def delayed() -> tuple[Impacts, Extraction]:
    train = strikes(COUNT, starts=delays(COUNT))
    return train, extract_modes(train)


@pytest.fixture(scope="module")
def exact(delayed: tuple[Impacts, Extraction]) -> tuple[Impacts, Extraction]:
    train = without_delays(*delayed, delays(COUNT))
    return train, extract_modes(train)


def test_a_field_and_the_gains_it_is_checked_by_do_not_depend_on_delays(
    delayed: tuple[Impacts, Extraction], exact: tuple[Impacts, Extraction]
) -> None:
    fields = [fit(train, FEATURES, modes, CONFIG) for train, modes in (delayed, exact)]
    known = [each.gain_field for each in fields]
    assert all(isinstance(each, MixtureGains) for each in known)
    assert distance(*(each.gains(delayed[0].contacts) for each in fields)) < ALIGNED
    # Between the contacts other hypotheses may be the more probable ones, which differ by less than is known.
    apart = fields[0].gains(FEATURES.points) - fields[1].gains(FEATURES.points)
    assert bool((apart.abs() < known[0].posterior(FEATURES.points).std[..., 0]).all())
    assert distance(*(torch.view_as_real(each.measured).flatten(1) for each in known)) < ALIGNED


def test_aligned_recordings_are_not_delayed_again(delayed: tuple[Impacts, Extraction]) -> None:
    train, modes = delayed
    aligned = modes.aligned(train)
    assert torch.equal(gain_data(aligned, FEATURES, modes, CONFIG).train.sounds, aligned.sounds)


def test_rows_are_grouped_by_place_in_the_order_of_the_table() -> None:
    contacts = torch.tensor([[2.0, 0, 0], [0, 0, 0], [2.001, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert rows_by_place(contacts) == ((0, 2), (1, 4), (3,))
    assert rows_by_place(contacts[:0]) == ()


def test_without_repeats_the_last_of_the_farthest_points_are_held_out() -> None:
    contacts = plate_impacts(COUNT).contacts
    assert len(rows_by_place(contacts)) == COUNT
    assert held_out(contacts, 0.25) == farthest_points(contacts, COUNT).tolist()[-3:]
    assert held_out(contacts, 0.0) == []


@pytest.mark.parametrize("apart", [0.0, 1e-3])
def test_repeats_are_held_out_with_their_places(apart: float) -> None:
    contacts = plate_impacts(COUNT).contacts
    once = held_out(contacts, 0.25)
    extent = (contacts.amax(0) - contacts.amin(0)).norm()
    again = contacts + apart * extent * torch.tensor([0.0, 0.0, 1.0], dtype=contacts.dtype)
    assert sorted(held_out(torch.cat([contacts, again]), 0.25)) == sorted(once + [row + COUNT for row in once])
