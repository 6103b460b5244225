"""The baselines that the paper leaves out: splines over contacts, and impacts from both sides."""

from dataclasses import replace

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.evaluation.simple_methods import MeanGains, SplineGains
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from oracles.plate import Plate, plate_modes, sample_contacts


def scattered(count: int, seed: int = 0) -> torch.Tensor:
    """Return places in a box, none near to another along its longest side."""
    drawn = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    drawn[:, 0] = (torch.arange(count) + 0.5 * drawn[:, 0]) / count
    return drawn * torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)


def flattened(places: torch.Tensor, directions: int) -> torch.Tensor:
    """Return the places in a tilted plane or on a tilted line."""
    kept = torch.zeros(3, dtype=torch.float64)
    kept[:directions] = 1.0
    return places * kept @ turned().T


def turned() -> torch.Tensor:
    return torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))).Q


def bumps(places: torch.Tensor) -> torch.Tensor:
    waves = torch.sin(places @ torch.tensor([[14.0, 0.0], [0.0, 18.0], [9.0, 5.0]], dtype=torch.float64))
    return waves[:, :1] + 0.5 * waves[:, 1:]


def spline(places: torch.Tensor, values: torch.Tensor) -> SplineGains:
    """Return the baseline of gains at places, a column a mode."""
    modes = values.shape[1]
    bank = ModalBank(100.0 + torch.arange(modes, dtype=torch.float64), torch.full((modes,), 5.0, dtype=torch.float64))
    impacts = Impacts(places, torch.zeros(len(places), 400), 8000.0, tuple(map(str, range(len(places)))))
    return SplineGains(impacts, Extraction(bank, values + 0j, Residual(torch.zeros(4))))


def gains(found: SplineGains, places: torch.Tensor) -> torch.Tensor:
    """Return the gains in phase."""
    return -found.complex_gains(places).imag


@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("directions", [1, 2, 3])
def test_a_linear_field_comes_back_exactly(directions: int, count: int) -> None:
    slopes = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    places, elsewhere = (flattened(each, directions) for each in (scattered(count), 3.0 * scattered(30, seed=1)))
    found = spline(places, places @ slopes + 2.0)
    assert found.report == {"kernel": "thin plate", "directions": directions, "sites": count}
    assert torch.allclose(gains(found, elsewhere), elsewhere @ slopes + 2.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 20])
@pytest.mark.parametrize("directions", [1, 2, 3])
def test_splines_pass_through_the_gains(directions: int, count: int) -> None:
    places = flattened(scattered(count), directions)
    assert torch.allclose(gains(spline(places, bumps(places)), places), bumps(places), rtol=0, atol=1e-9)


def test_few_sites_make_a_function_that_does_not_run_away() -> None:
    end = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
    values = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    asked = torch.tensor([[0.025, 0.0, 0.0], [9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]], dtype=torch.float64)
    # Straight between two sites, level beyond them.
    expected = torch.tensor([[1.5], [3.0], [1.0]], dtype=torch.float64)
    assert torch.allclose(gains(spline(end, values), asked), expected)
    assert torch.equal(gains(spline(end[:1], values[:1]), asked), torch.ones(3, 1, dtype=torch.float64))
    far = 1e3 * (scattered(20, seed=1) - scattered(1))
    for count in (3, 4, 7):
        few = spline(scattered(count), bumps(scattered(count)))
        assert few.report["kernel"] == "distance"
        assert float(gains(few, far).abs().max()) < 20.0
    assert spline(flattened(scattered(6), 2), bumps(scattered(6))).report["kernel"] == "thin plate"


def test_a_spline_belongs_to_the_object_and_not_to_its_frame_or_order() -> None:
    places, elsewhere = scattered(20), scattered(30, seed=1)
    straight = gains(spline(places, bumps(places)), elsewhere)
    moved = [each @ turned().T + torch.tensor([1.0, -2.0, 0.5]) for each in (places, elsewhere)]
    assert torch.allclose(gains(spline(moved[0], bumps(places)), moved[1]), straight, rtol=0, atol=1e-9)
    rows = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(gains(spline(places[rows], bumps(places)[rows]), elsewhere), straight, rtol=0, atol=1e-9)


def test_impacts_in_one_place_count_as_their_mean() -> None:
    places, elsewhere = scattered(10), scattered(30, seed=1)
    values = bumps(places)
    again = torch.cat([places, places[2:4], places[2:3]])
    twice = torch.cat([values, values[2:4] + 1.0, values[2:3] + 2.0])
    mean = values.clone()
    mean[2] += 1.0
    mean[3] += 0.5
    expected = gains(spline(places, mean), elsewhere)
    assert torch.allclose(gains(spline(again, twice), elsewhere), expected, rtol=0, atol=1e-9)


def two_sided(count: int = 14) -> tuple[Impacts, Extraction, Extraction]:
    """Return blows on a plate, a few of them from below, with the gains that these have and those from above."""
    plate = Plate()
    contacts = sample_contacts(plate, count, generator=torch.Generator().manual_seed(0))
    modes = plate_modes(plate, contacts, highest=2500.0)
    above = modes.gains.float()
    sides = torch.ones(count, 1)
    sides[[1, 5, 6]] = -1.0
    directions = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64) * sides
    bank = ModalBank(modes.frequency, modes.damping)
    sounds = torch.zeros(count, 400)
    impacts = Impacts(contacts, sounds, 8000.0, tuple(map(str, range(count))), directions)
    return (
        impacts,
        Extraction(bank, above * sides + 0j, Residual(torch.zeros(4))),
        Extraction(bank, above + 0j, Residual(torch.zeros(4))),
    )


@pytest.mark.parametrize("baseline", [MeanGains, SplineGains])
def test_blows_from_the_other_side_do_not_cancel(baseline):
    impacts, both_sides, from_above = two_sided()
    asked = sample_contacts(Plate(), 20, generator=torch.Generator().manual_seed(1))
    expected = baseline(replace(impacts, directions=None), from_above).complex_gains(asked)
    assert torch.allclose(baseline(impacts, both_sides).complex_gains(asked), expected, rtol=0, atol=1e-6)
    # Without directions nothing tells them apart.
    blind = baseline(replace(impacts, directions=None), both_sides).complex_gains(asked)
    assert float((blind - expected).abs().max()) > 0.3 * float(expected.abs().max())
