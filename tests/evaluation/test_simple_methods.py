"""Baselines made of the training recordings, in closed form and on a measured tree."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from avmsf.capture import CaptureSettings, read_capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import CaptureWarning, EvaluationError
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.simple_methods import MeanGains, MeanWaveform, NearestRecording, SplineGains, WhiteNoise, floor
from avmsf.evaluation.splits import split
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.raising import raises
from oracles.plate import Plate, plate_modes, sample_contacts, strike

PLATE = Plate()
X, Y, OPPOSITE = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]


def plate_impacts(count: int = 30, *, noise_db: float | None = None) -> Impacts:
    return strike(PLATE, count, sample_rate=22050.0, seconds=0.2, seed=0, noise_db=noise_db)


def true_extraction(impacts: Impacts) -> Extraction:
    modes = plate_modes(PLATE, impacts.contacts)
    return Extraction(ModalBank(modes.frequency, modes.damping), modes.gains.float() + 0j, Residual(torch.zeros(4)))


def test_white_noise_is_white_and_as_loud_as_the_training_sounds():
    train, test = split(plate_impacts(), 0.2)
    sounds = WhiteNoise(train, seed=1).render(test.contacts)
    loudness = float(train.sounds.square().mean(dim=1).sqrt().mean())
    # 24 sounds of 4410 samples: the standard error of a root mean square is .2 %.
    assert float(sounds.square().mean().sqrt()) == pytest.approx(loudness, rel=0.01)
    normal = sounds / sounds.square().mean().sqrt()
    assert abs(float((normal[:, 1:] * normal[:, :-1]).mean())) < 4 / math.sqrt(sounds.numel())
    # Another noise for each contact and each seed.
    assert abs(float((normal[0] * normal[1]).mean())) < 4 / math.sqrt(4410)
    assert not torch.equal(WhiteNoise(train, seed=2).render(test.contacts), sounds)
    zeros = (WhiteNoise(train).render(torch.tensor([[zero, 1.0, zero]])) for zero in (0.0, -0.0))
    assert torch.equal(*zeros)


def test_nearest_and_means_are_those_of_a_full_search():
    train, test = split(plate_impacts(), 0.2)
    order = torch.cdist(test.contacts, train.contacts).argsort(dim=1)
    assert torch.equal(NearestRecording(train).render(test.contacts), train.sounds[order[:, 0]])
    for count in (1, 3, 6):
        expected = train.sounds[order[:, :count]].mean(dim=1)
        found = MeanWaveform(train, count=count).render(test.contacts)
        assert torch.allclose(found, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
        # The plate's sound is linear in its gains; what remains is float32.
        gains = MeanGains(train, true_extraction(train), count=count).render(test.contacts)
        assert torch.allclose(gains, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_means_of_more_than_there_are_are_of_all_and_of_none_are_refused():
    train, test = split(plate_impacts(), 0.2)
    mean = MeanWaveform(train, count=len(train) + 1)
    assert torch.allclose(mean.render(test.contacts), train.sounds.mean(0).expand(len(test), -1), atol=1e-6)
    with raises(EvaluationError, name="count", value=0):
        MeanWaveform(train, count=0).render(test.contacts)


def test_mean_gains_have_both_phases():
    train, _ = split(plate_impacts(), 0.2)
    extraction = true_extraction(train)
    turned = replace(extraction, gains=1j * extraction.gains)
    sounds = MeanGains(train, turned, count=1).render(train.contacts)
    times = torch.arange(sounds.shape[1], dtype=torch.float64) / 22050.0
    bank = extraction.bank
    cosines = torch.exp(-bank.damping[:, None] * times) * torch.cos(2 * math.pi * bank.frequency[:, None] * times)
    expected = extraction.gains.real.double() @ cosines
    assert torch.allclose(sounds.double(), expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_the_floor_is_the_noise_alone():
    impacts, clean = plate_impacts(noise_db=-40.0), plate_impacts()
    bank = true_extraction(impacts).bank
    left = (floor(impacts, bank) - impacts.sounds).square().mean() / impacts.sounds.square().mean()
    # Least squares takes away the noise in as many directions of 4410 as there are gains, so 2 % at most.
    assert 10 * math.log10(float(left)) == pytest.approx(-40.0, abs=0.15)
    left = (floor(clean, bank) - clean.sounds).square().mean() / clean.sounds.square().mean()
    assert 10 * math.log10(float(left)) < -90.0


def scattered(count: int, seed: int = 0) -> torch.Tensor:
    """Return points in a box, none near to another along its longest side."""
    drawn = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    drawn[:, 0] = (torch.arange(count) + 0.5 * drawn[:, 0]) / count
    return drawn * torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)


def rotation() -> torch.Tensor:
    return torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))).Q


def flattened(points: torch.Tensor, directions: int) -> torch.Tensor:
    """Return the points in a tilted plane or on a tilted line."""
    return points * (torch.arange(3) < directions) @ rotation().T


def bumps(points: torch.Tensor) -> torch.Tensor:
    waves = torch.sin(points @ torch.tensor([[14.0, 0.0], [0.0, 18.0], [9.0, 5.0]], dtype=torch.float64))
    return waves[:, :1] + 0.5 * waves[:, 1:]


def spline(points: torch.Tensor, values: torch.Tensor) -> SplineGains:
    """Return the baseline of gains at points, a column a mode."""
    modes = values.shape[1]
    bank = ModalBank(100.0 + torch.arange(modes, dtype=torch.float64), torch.full((modes,), 5.0, dtype=torch.float64))
    impacts = Impacts(points, torch.zeros(len(points), 400), 8000.0, tuple(map(str, range(len(points)))))
    return SplineGains(impacts, Extraction(bank, values + 0j, Residual(torch.zeros(4))))


def gains_of(found: SplineGains, points: torch.Tensor) -> torch.Tensor:
    """Return the gains in phase."""
    return -found.complex_gains(points).imag


@pytest.mark.parametrize("count", [8, 20])
@pytest.mark.parametrize("directions", [1, 2, 3])
def test_a_linear_field_comes_back_exactly(directions: int, count: int) -> None:
    slopes = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    points, elsewhere = (flattened(each, directions) for each in (scattered(count), 3.0 * scattered(30, seed=1)))
    found = spline(points, points @ slopes + 2.0)
    assert torch.allclose(gains_of(found, elsewhere), elsewhere @ slopes + 2.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 20])
@pytest.mark.parametrize("directions", [1, 2, 3])
def test_splines_pass_through_the_gains(directions: int, count: int) -> None:
    points = flattened(scattered(count), directions)
    assert torch.allclose(gains_of(spline(points, bumps(points)), points), bumps(points), rtol=0, atol=1e-9)


def test_few_sites_make_a_function_that_does_not_run_away() -> None:
    end = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
    values = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    asked = torch.tensor([[0.025, 0.0, 0.0], [9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]], dtype=torch.float64)
    # Straight between two sites, level beyond them.
    expected = torch.tensor([[1.5], [3.0], [1.0]], dtype=torch.float64)
    assert torch.allclose(gains_of(spline(end, values), asked), expected)
    assert torch.equal(gains_of(spline(end[:1], values[:1]), asked), torch.ones(3, 1, dtype=torch.float64))
    far = 1e3 * (scattered(20, seed=1) - scattered(1))
    for count in (3, 4, 7):
        few = spline(scattered(count), bumps(scattered(count)))
        assert float(gains_of(few, far).abs().max()) < 20.0


def test_impacts_in_one_position_count_as_their_mean() -> None:
    points, elsewhere = scattered(10), scattered(30, seed=1)
    values = bumps(points)
    again = torch.cat([points, points[2:4], points[2:3]])
    twice = torch.cat([values, values[2:4] + 1.0, values[2:3] + 2.0])
    mean = values.clone()
    mean[2:4] += torch.tensor([[1.0], [0.5]])
    expected = gains_of(spline(points, mean), elsewhere)
    assert torch.allclose(gains_of(spline(again, twice), elsewhere), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("baseline", [MeanGains, SplineGains])
def test_impacts_from_the_other_side_do_not_cancel(baseline):
    contacts = sample_contacts(PLATE, 14, generator=torch.Generator().manual_seed(0))
    modes = plate_modes(PLATE, contacts, highest=2500.0)
    above = modes.gains.float()
    sides = torch.ones(14, 1)
    sides[[1, 5, 6]] = -1.0
    directions = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64) * sides
    struck = Impacts(contacts, torch.zeros(14, 400), 8000.0, tuple(map(str, range(14))), directions)
    bank, silent = ModalBank(modes.frequency, modes.damping), Residual(torch.zeros(4))
    from_above, from_both = (Extraction(bank, gains + 0j, silent) for gains in (above, above * sides))
    asked = sample_contacts(PLATE, 20, generator=torch.Generator().manual_seed(1))
    expected = baseline(replace(struck, directions=None), from_above).complex_gains(asked)
    assert torch.allclose(baseline(struck, from_both).complex_gains(asked), expected, rtol=0, atol=1e-6)
    # Without directions nothing tells them apart.
    blind = baseline(replace(struck, directions=None), from_both).complex_gains(asked)
    assert float((blind - expected).abs().max()) > 0.3 * float(expected.abs().max())


def along_x(positions: list[float], directions: list[list[float]]) -> Impacts:
    """Return impacts along the axis x whose sounds differ in every sample."""
    count = len(positions)
    sounds = torch.randn(count, 64, generator=torch.Generator().manual_seed(0))
    contacts = torch.tensor([[x, 0.0, 0.0] for x in positions], dtype=torch.float64)
    return Impacts(contacts, sounds, 8000.0, tuple(f"{row}.wav" for row in range(count)), torch.tensor(directions))


def rendered(train: Impacts, position: float, direction: list[float], *, count: int = 1) -> torch.Tensor:
    """Return the sound of one contact on the axis x."""
    contact = torch.tensor([[position, 0.0, 0.0]], dtype=torch.float64)
    return MeanWaveform(train, count, by_direction=True).render(contact, directions=torch.tensor([direction]))[0]


def test_an_opposite_impact_negates_the_sound_and_does_not_cancel() -> None:
    train = along_x([0.0, 1.0], [X, X])
    assert torch.equal(rendered(train, 0.1, OPPOSITE), -train.sounds[0])
    assert torch.equal(rendered(train, 0.1, X), train.sounds[0])
    train = along_x([0.0, 1.0], [X, OPPOSITE])
    train = replace(train, sounds=train.sounds[:1] * torch.tensor([[1.0], [-1.0]]))
    assert torch.equal(rendered(train, 0.5, X, count=2), train.sounds[0])
    assert not rendered(replace(train, directions=None), 0.5, X, count=2).any()
    # Rounding gives a perpendicular impact no sign.
    train = along_x([0.0, 1.0], [[-6e-17, -1.0, -6e-17], X])
    assert torch.equal(rendered(train, 0.0, X, count=2), train.sounds.mean(dim=0))


# The box is 2 long. At the contact itself a perpendicular impact is 1 away, one at a cosine of .8, on either side,
# (2 / 2)^2 (1 - .8) = .447^2, and a parallel one the distance of its contact.
@pytest.mark.parametrize(
    ("direction", "distance", "nearest"),
    [(Y, 0.99, 1), (Y, 1.01, 0), ([-0.8, 0.6, 0.0], 0.44, 1), ([-0.8, 0.6, 0.0], 0.46, 0)],
)
def test_an_impact_is_farther_by_the_cosine_of_its_direction(direction, distance, nearest):
    train = along_x([0.0, distance, 2.0], [direction, X, Y])
    assert rendered(train, 0.0, X).abs().equal(train.sounds[nearest].abs())


@pytest.mark.parametrize("known", ["alike", "in training alone", "in test alone", "nowhere"])
def test_without_directions_that_differ_it_is_the_papers(known: str) -> None:
    slanted = normalize(torch.tensor([[0.3, -0.5, -0.8]])).expand(30, 3)
    train, test = split(replace(plate_impacts(30), directions=slanted), 0.2)
    train = train if known in ("alike", "in training alone") else replace(train, directions=None)
    directions = test.directions if known in ("alike", "in test alone") else None
    plain, directed = (
        MeanWaveform(train, by_direction=each).render(test.contacts, directions=directions) for each in (False, True)
    )
    assert torch.equal(directed, plain)


@pytest.mark.slow
def test_directions_lower_the_error_of_a_tree_struck_in_two(shared: Path) -> None:
    """43 places of a measured tree, each struck in two perpendicular directions; learnt from 20 places."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CaptureWarning)
        tree = read_capture(shared / "tree43", CaptureSettings()).impacts
    errors = []
    for start in (0, 18):
        train, test = split(tree, 20, start=start)
        renderers = (MeanWaveform(train), MeanWaveform(train, by_direction=True))
        errors.append([evaluate(renderer, test).mean()["relative_stft"] for renderer in renderers])
    plain, directed = np.mean(errors, axis=0)
    # Of the three nearest recordings one or two are of the other direction, in whose sound other modes are loud.
    assert plain > 0.55
    assert directed < 0.4
