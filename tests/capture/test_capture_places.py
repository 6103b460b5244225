"""Which contacts are one place: those that nobody can tell apart, whatever their order."""

import torch

from avmsf.capture.impacts import SAME_PLACE, places_of


def test_contacts_nearer_than_a_hundredth_are_one_place():
    """Of the diagonal of the box around all; farther ones are not, and equal ones are always."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], dtype=torch.float64)
    near = torch.tensor([[1.0, 1.0, 0.0], [1.049, 1.0, 0.0], [2.0, 2.0, 0.0], [2.051, 2.0, 0.0]], dtype=torch.float64)
    places = places_of(torch.cat([corners, near, near[:1], corners[1:]]))
    assert places.unique().tolist() == [0, 1, 2, 3, 4]
    groups = [[0], [1, 7], [2, 3, 6], [4], [5]]
    assert sorted(torch.nonzero(places == place).flatten().tolist() for place in places.unique()) == groups
    assert places_of(corners[:1]).tolist() == [0]
    assert places_of(corners[[0, 0]]).tolist() == [0, 0]


def test_places_do_not_grow_along_a_row():
    """Of contacts each near to the next; nothing depends on the order of contacts."""
    along = torch.linspace(0.0, 1.0, 161, dtype=torch.float64)
    contacts = along[:, None] * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    places = places_of(contacts)
    for place in places.unique():
        assert float(along[places == place].max() - along[places == place].min()) <= SAME_PLACE
    assert len(places.unique()) < 161
    order = torch.randperm(161, generator=torch.Generator().manual_seed(0))
    together = places[:, None] == places
    assert torch.equal((places_of(contacts[order])[:, None] == places_of(contacts[order])), together[order][:, order])
