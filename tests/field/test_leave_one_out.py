"""Leave-one-out predictions in closed form, against Gaussian processes and splines solved without each place."""

from dataclasses import replace

import pytest
import torch

from avmsf.field import thinplate
from avmsf.field.hypotheses import NOISES, REMAINDERS, UNHEARD, WIDTHS, nearness
from avmsf.field.modalbasis import REACH, ModalBasis
from avmsf.field.thinplate import SplineSites
from avmsf.field.thinplategains import ThinPlateGains
from believing_field import (
    BANK,
    DOWN,
    ELASTIC,
    LENGTH,
    bar_contacts,
    bar_points,
    bar_surface,
    drawn_gains,
    physics_field,
    spline_field,
)

PLACES = 9


def struck_again() -> tuple[torch.Tensor, list[list[int]]]:
    """Return contacts at nine places, two of which were struck twice and one three times, and the rows of each place.

    A second contact with the last place is a little off it, by .2 % of the bar.
    """
    first = bar_contacts(PLACES)
    near = first[8] + torch.tensor([0.002 * LENGTH, 0.0, 0.0], dtype=torch.float64)
    contacts = torch.cat([first, first[[0, 3, 3]], near[None]])
    return contacts, [[0, 9], [1], [2], [3, 10, 11], [4], [5], [6], [7], [8, 12]]


def scattered_gains(contacts: torch.Tensor, *, seed: int) -> torch.Tensor:
    """Return gains at contacts; two of one place differ."""
    first = drawn_gains(bar_contacts(PLACES), seed=seed)[[*range(PLACES), 0, 3, 3, 8]]
    return first + 0.2 * torch.randn(first.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def without_a_place(gains: ModalBasis, rows: list[int]) -> torch.Tensor:
    """Return the gains at some rows that a mixture of Gaussian processes predicts from the others, written out.

    Contacts that say nothing are not among the others. How likely hypotheses are beforehand is what takes the evidence
    of all gains to the weights.
    """
    contacts, values, doubt = gains.contacts, gains.values, gains.regression.doubt
    shapes = bar_surface().along(contacts, DOWN.expand(len(contacts), 3))[0]
    heard = [row for row in range(len(contacts)) if doubt[row] < UNHEARD]
    others = [row for row in heard if row not in rows]
    smooth = torch.exp(-0.5 * (torch.cdist(contacts, contacts) / (REACH * gains.surface.size)).square())
    priors = nearness(BANK.frequency, ELASTIC)
    found = torch.empty(len(rows), values.shape[1], 2, dtype=torch.float64)
    for mode in range(values.shape[1]):
        means, logs = [], []
        for width in range(len(WIDTHS)):
            prior = priors[mode, width]
            prior = prior / (shapes[heard].square() @ prior).mean()
            for part in REMAINDERS:
                kernel = (1 - part) * (shapes * prior) @ shapes.T + part * smooth
                for noise in NOISES:
                    weight = gains.regression.weights[len(means), mode]
                    evidence = []
                    for known in (heard, others):
                        covariance = kernel[known][:, known] + noise * torch.eye(len(known), dtype=torch.float64)
                        solved = torch.linalg.solve(covariance, values[known, mode])
                        squares = (values[known, mode] * solved).sum(0)
                        evidence.append(-0.5 * (torch.logdet(covariance) + len(known) * torch.log(squares)))
                    means.append(kernel[rows][:, others] @ solved)
                    logs.append(torch.log(weight) + evidence[1] - evidence[0])
        found[:, mode] = (torch.softmax(torch.stack(logs), 0)[:, None] * torch.stack(means)).sum(0)
    return found


@pytest.mark.parametrize("wrong", [None, 4, 3], ids=["all-trusted", "one-place-doubted", "one-of-three-doubted"])
def test_elastic_shapes_predict_a_place_as_gaussian_processes_without_it(wrong: int | None) -> None:
    contacts, parts = struck_again()
    gains = physics_field(contacts, scattered_gains(contacts, seed=4))
    if wrong is not None:
        doubt = gains.regression.doubt.clone()
        doubt[wrong] = UNHEARD
        gains = replace(gains, regression=replace(gains.regression, doubt=doubt))
    predicted = gains.leave_one_out()
    assert predicted.shape == gains.values.shape
    for rows in parts:
        # A contact that is doubted has a millionth of the others' weight, not none.
        torch.testing.assert_close(predicted[rows], without_a_place(gains, rows), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("smoothing", [0.0, 0.03])
def test_splines_predict_a_place_as_splines_without_it(smoothing: float) -> None:
    contacts, parts = struck_again()
    values = scattered_gains(contacts, seed=5)
    gains = replace(spline_field(contacts, values), smoothing=smoothing)
    predicted = gains.leave_one_out()
    assert predicted.shape == values.shape
    for rows in parts:
        others = [row for row in range(len(contacts)) if row not in rows]
        # The unit of length is the longest extent; r^2 log r goes with its square.
        ratio = float(SplineSites(contacts[others], 0.0).axes.norm() / gains.sites.axes.norm())
        part = SplineSites(contacts[others], smoothing * ratio**2)
        weights = part.weights(contacts[rows].mean(0, keepdim=True))
        expected = torch.einsum("pc,cmd->pmd", weights, values[others]).expand(len(rows), -1, -1)
        torch.testing.assert_close(predicted[rows], expected, rtol=0, atol=1e-7)


def test_the_one_contact_off_a_plane_is_predicted_by_splines_over_the_plane() -> None:
    flat = bar_contacts(11)
    above = torch.tensor([[0.2, 0.05, 0.1]], dtype=torch.float64)
    contacts = torch.cat([flat, above])
    values = drawn_gains(torch.cat([flat, flat[:1]]), seed=6)
    gains = ThinPlateGains(bar_points(), contacts, values, 0.0)
    known = ThinPlateGains(bar_points(), flat, values[:11], 0.0).at(above)
    assert known.quadrature is not None
    expected = torch.stack([known.mean, known.quadrature], dim=2).double()
    predicted = gains.leave_one_out()
    torch.testing.assert_close(predicted[11:], expected)
    for row in (0, 5):
        others = [each for each in range(12) if each != row]
        weights = SplineSites(contacts[others], 0.0).weights(contacts[row : row + 1])
        expected = torch.einsum("pc,cmd->pmd", weights, values[others])
        torch.testing.assert_close(predicted[row : row + 1], expected, rtol=0, atol=1e-7)


def test_without_one_of_the_fewest_places_that_splines_bend_between_they_do_not_bend() -> None:
    contacts = bar_contacts(6)
    values = drawn_gains(contacts, seed=7)
    gains = ThinPlateGains(bar_points(), contacts, values, 0.0)
    assert gains.sites.bending
    predicted = gains.leave_one_out()
    for row in range(6):
        others = [each for each in range(6) if each != row]
        part = SplineSites(contacts[others], 0.0)
        assert not part.bending
        expected = torch.einsum("pc,cmd->pmd", part.weights(contacts[row : row + 1]), values[others])
        torch.testing.assert_close(predicted[row : row + 1], expected, rtol=0, atol=1e-6)


def test_contacts_nearer_than_a_hundredth_of_the_box_are_one_place() -> None:
    contacts, parts = struck_again()
    owner = thinplate.places_of(contacts)
    assert sorted(torch.unique(owner).tolist()) == list(range(PLACES))
    for rows in parts:
        assert len(set(owner[rows].tolist())) == 1
