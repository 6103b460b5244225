"""Vectors of mode sets in closed form, and the space that UMAP makes of them."""

import importlib.util
import math
import sys

import numpy as np
import pytest
import torch

from avmsf.errors import EvaluationError
from avmsf.evaluation.mode_embedding import FEATURES, MaterialSpace, check_materials, pitches, pitches_and_dampings
from avmsf.modal.modes import ModalBank
from factories.raising import raises


def bank(frequency: list[float] | torch.Tensor, damping: list[float] | torch.Tensor | float = 10.0) -> ModalBank:
    frequency = torch.as_tensor(frequency, dtype=torch.float64)
    return ModalBank(frequency, torch.as_tensor(damping, dtype=torch.float64).expand(len(frequency)).clone())


def random_bank(modes: int, *, seed: int, pitch: float = 0.0, decay: float = 0.0) -> ModalBank:
    drawn = torch.rand(2, modes, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return bank(2 ** (9 + 4 * drawn[0] + pitch), 2 ** (3 + drawn[1] + decay))


def shift(features, first: ModalBank, second: ModalBank) -> float:
    return float(np.linalg.norm(features(first) - features(second)))


@pytest.mark.parametrize("modes", [1, 7, 200])
def test_an_octave_and_twice_the_damping_are_one_away(modes):
    low, high, fast = (random_bank(modes, seed=0, **change) for change in ({}, {"pitch": 1.0}, {"decay": 1.0}))
    assert shift(pitches, low, high) == pytest.approx(1.0, abs=1e-12)
    assert shift(pitches_and_dampings, low, fast) == pytest.approx(1.0, abs=1e-12)
    assert shift(pitches, low, fast) == 0.0


def test_dampings_are_taken_where_their_pitch_is():
    # d = 3 (f / 1000)^2 is a straight line of slope 2; inside a dense set, its mean around a pitch is its value there.
    frequency = 2 ** torch.linspace(5, 16, 2000, dtype=torch.float64)
    curve = pitches_and_dampings(bank(frequency, 3.0 * (frequency / 1000) ** 2))[32:] * math.sqrt(15)
    expected = math.log2(3.0) + 2 * (np.linspace(math.log2(125.0), math.log2(16000.0), 15) - math.log2(1000.0))
    assert np.abs(curve - expected)[2:-4] == pytest.approx(0.0, abs=0.01)
    # Far from every mode the nearest one counts.
    assert pitches_and_dampings(bank([15.0, 16.0], [4.0, 32.0]))[-1] * math.sqrt(15) == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("features", FEATURES.values(), ids=FEATURES)
def test_neither_order_nor_number_of_modes_matters(features):
    one = random_bank(20, seed=1)
    permuted = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    assert shift(features, one, bank(one.frequency[permuted], one.damping[permuted])) < 1e-12
    # Quantiles of repeated modes are interpolated a little otherwise.
    dense = bank(2 ** (9 + 4 * torch.linspace(0, 1, 100)), 8.0)
    assert shift(features, dense, bank(dense.frequency.repeat(9), 8.0)) < 0.02


def labelled(count: int = 8) -> tuple[list[ModalBank], list[str]]:
    """Return deep dull objects, and bright ones three octaves above them."""
    low = [random_bank(20 + row, seed=row, decay=2.0) for row in range(count)]
    high = [random_bank(30 - row, seed=50 + row, pitch=3.0) for row in range(count)]
    return [*low, *high], ["wood"] * count + ["glass"] * count


def space_of(banks: list[ModalBank], materials: list[str], *, seed: int = 0) -> MaterialSpace:
    return MaterialSpace.of(banks, materials, names=[f"object {row}" for row in range(len(banks))], seed=seed)


@pytest.mark.slow
def test_like_is_near_unlike_far_and_a_seed_gives_the_same_space():
    # Importing it compiles for many seconds, which only its embeddings need.
    if importlib.util.find_spec("umap") is None:
        pytest.skip("needs pip install 'avmsf[eval]'")
    space, again = (space_of(*labelled(), seed=3) for _ in range(2))
    wood, glass = space.place(random_bank(25, seed=99)), space.place(random_bank(25, seed=98, pitch=3.0))
    assert space.distance(wood, "wood") < 0.5 * space.distance(wood, "glass")
    assert space.distance(glass, "glass") < 0.5 * space.distance(glass, "wood")
    assert space.nearest_neighbor_accuracy() == 1.0
    assert np.array_equal(again.embedding, space.embedding)
    assert np.array_equal(again.place(random_bank(25, seed=99)), wood)
    assert not np.array_equal(space_of(*labelled(), seed=4).embedding, space.embedding)


@pytest.mark.parametrize(
    ("make", "attributes"),
    [
        (lambda: pitches(bank([])), {"name": "bank", "value": 0}),
        (lambda: pitches_and_dampings(bank([100.0, 0.0])), {"row": 1, "name": "frequency", "value": 0.0}),
        (lambda: pitches_and_dampings(bank([100.0], math.nan)), {"row": 0, "name": "damping"}),
        (lambda: check_materials(["wood"] * 4), {"name": "materials", "value": (4, 1)}),
        (lambda: space_of(*labelled()).embedding, {"name": "umap-learn"}),
    ],
)
def test_what_makes_no_space_is_refused(make, attributes, monkeypatch):
    monkeypatch.setitem(sys.modules, "umap", None)
    with raises(EvaluationError, **attributes):
        make()
