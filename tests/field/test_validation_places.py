"""What is held out to choose settings by is at places that nothing else is learned from."""

from dataclasses import replace

import pytest
import torch

from avmsf.capture.impacts import rows_by_place
from avmsf.features.feature_field import FeatureField
from avmsf.field.gains.attention import held_out
from avmsf.gaussians.points import farthest_points
from factories.plate_field import QUICK, plate_extraction, plate_fit, plate_impacts

COUNT = 12


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


def test_a_fit_validates_at_places_it_does_not_learn_from() -> None:
    impacts = plate_impacts(COUNT)
    names = tuple(f"{row:02d}" for row in range(2 * COUNT))
    twice = replace(impacts.take([*range(COUNT)] * 2), names=names)
    config = replace(QUICK, damping="validated", warmup_steps=1, steps=1)
    features = FeatureField.from_contacts(impacts.contacts)
    report = plate_fit(config, train=twice, features=features, modes=plate_extraction(twice)).origin.report
    held = {int(name) for name in report["validation_contacts"]}
    assert len(held) == 6
    assert {row % COUNT for row in held}.isdisjoint(row % COUNT for row in set(range(2 * COUNT)) - held)
