"""The mean waveform of neighbors in place and direction, in closed form and on a measured tree."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from avmsf.capture import CaptureSettings, read_capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import CaptureWarning
from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import split
from factories.plate_field import plate_impacts

X, Y = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
OPPOSITE = [-1.0, 0.0, 0.0]


def impacts(positions: list[float], directions: list[list[float]]) -> Impacts:
    """Return impacts along the axis x whose sounds differ in every sample."""
    count = len(positions)
    sounds = torch.randn(count, 64, generator=torch.Generator().manual_seed(0))
    contacts = torch.tensor([[x, 0.0, 0.0] for x in positions], dtype=torch.float64)
    return Impacts(contacts, sounds, 8000.0, tuple(f"{row}.wav" for row in range(count)), torch.tensor(directions))


def rendered(train: Impacts, position: float, direction: list[float], *, count: int = 1) -> torch.Tensor:
    """Return the sound of one contact on the axis x."""
    mean = MeanWaveform(train, count, by_direction=True)
    contact = torch.tensor([[position, 0.0, 0.0]], dtype=torch.float64)
    return mean.render(contact, directions=torch.tensor([direction]))[0]


def test_an_opposite_impact_negates_the_sound() -> None:
    train = impacts([0.0, 1.0], [X, X])
    assert torch.equal(rendered(train, 0.1, OPPOSITE), -train.sounds[0])
    assert torch.equal(rendered(train, 0.1, X), train.sounds[0])


def test_neighbors_of_opposite_directions_do_not_cancel() -> None:
    train = impacts([0.0, 1.0], [X, OPPOSITE])
    train = replace(train, sounds=train.sounds[:1] * torch.tensor([[1.0], [-1.0]]))
    assert torch.equal(rendered(train, 0.5, X, count=2), train.sounds[0])
    assert not rendered(replace(train, directions=None), 0.5, X, count=2).any()


@pytest.mark.parametrize(("distance", "nearest"), [(0.99, 1), (1.01, 0)])
def test_a_perpendicular_impact_is_half_the_object_away(distance: float, nearest: int) -> None:
    # The box is 2 long. At the contact itself a perpendicular impact is 1 away, a parallel one `distance`.
    train = impacts([0.0, distance, 2.0], [Y, X, Y])
    assert torch.equal(rendered(train, 0.0, X), train.sounds[nearest])


@pytest.mark.parametrize(("distance", "nearest"), [(0.44, 1), (0.46, 0)])
def test_an_oblique_impact_is_farther_by_its_cosine(distance: float, nearest: int) -> None:
    # (2 / 2)^2 (1 - .8) = .447^2, on either side.
    train = impacts([0.0, distance, 2.0], [[-0.8, 0.6, 0.0], X, X])
    assert rendered(train, 0.0, X).abs().equal(train.sounds[nearest].abs())


def test_rounding_gives_a_perpendicular_impact_no_sign() -> None:
    train = impacts([0.0, 1.0], [[-6e-17, -1.0, -6e-17], X])
    assert torch.equal(rendered(train, 0.0, X, count=2), train.sounds.mean(dim=0))


@pytest.mark.parametrize("known", ["alike", "in training alone", "in test alone", "nowhere"])
def test_without_directions_that_differ_it_is_the_papers(known: str) -> None:
    plate = plate_impacts(30, seconds=0.05)
    slanted = normalize(torch.tensor([[0.3, -0.5, -0.8]])).expand(30, 3)
    train, test = split(replace(plate, directions=slanted), 0.2)
    train = train if known in ("alike", "in training alone") else replace(train, directions=None)
    directions = test.directions if known in ("alike", "in test alone") else None
    sounds = {
        name: MeanWaveform(train, by_direction=name == "directed").render(test.contacts, directions=directions)
        for name in ("plain", "directed")
    }
    assert torch.equal(sounds["directed"], sounds["plain"])
    assert not torch.equal(sounds["plain"], train.sounds[:1].expand_as(test.sounds))


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
