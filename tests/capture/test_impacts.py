"""Recordings cut anew at other starts, and which contacts are one place."""

import math

import torch

from avmsf.capture.impacts import SAME_PLACE, Impacts, places_of
from avmsf.errors import ArrayError
from factories.raising import raises

RATE = 8000.0


def impacts(sounds, before=None, after=None):
    return Impacts(
        torch.zeros(len(sounds), 3), sounds, RATE, tuple(map(str, range(len(sounds)))), before=before, after=after
    )


def band_limited(times):
    """Tones up to .4 of the rate, under a slow envelope that is smooth everywhere."""
    tones = sum(torch.cos(2 * math.pi * f * times + f) for f in (310.0, 1203.0, 2511.0, 3200.0))
    return tones * torch.exp(-((times - 0.05) ** 2) / 2e-3)


def test_whole_samples_are_those_of_the_file() -> None:
    file = torch.randn(2, 300, generator=torch.Generator().manual_seed(0))
    cut = impacts(file[:, 20:280], file[:, :20], file[:, 280:]).delayed(torch.tensor([-7.0, 5.0], dtype=torch.float64))
    assert torch.equal(cut.sounds, torch.stack([file[0, 13:273], file[1, 25:285]]))
    assert cut.before is None
    assert cut.after is None


def test_between_samples_a_band_limited_signal_is_interpolated() -> None:
    times = torch.arange(900, dtype=torch.float64) / RATE
    file = band_limited(times)[None].repeat(3, 1)
    delays = torch.tensor([0.37, -4.5, 11.04], dtype=torch.float64)
    cut = impacts(file[:, 50:850], file[:, :50], file[:, 850:]).delayed(delays)
    expected = torch.stack([band_limited(times[50:850] + delay / RATE) for delay in delays.tolist()])
    assert float((cut.sounds - expected).abs().max()) < 1e-3 * float(expected.abs().max())


def test_what_a_file_does_not_hold_is_zero() -> None:
    file = torch.ones(1, 100)
    before = torch.full((1, 4), torch.nan)
    before[:, 2:] = 1.0
    cut = impacts(file, before, torch.zeros(1, 0)).delayed(torch.tensor([-6.0], dtype=torch.float64)).sounds
    assert torch.equal(cut, torch.cat([torch.zeros(1, 4), torch.ones(1, 96)], dim=1))


def test_delays_are_numbers() -> None:
    with raises(ArrayError, row=0, name="delays"):
        impacts(torch.ones(1, 100)).delayed(torch.tensor([math.nan], dtype=torch.float64))


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
