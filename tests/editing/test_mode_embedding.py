"""Vectors of mode sets in closed form, and the space that UMAP makes of them: seeded, stored, and made again."""

import importlib.util
import math
import sys

import numpy as np
import pytest
import torch

from avmsf.errors import EvaluationError
from avmsf.modal.modes import ModalBank
from benchmarks.mode_embedding import FEATURES, MaterialSpace, pitches, rings
from factories.raising import raises


def bank(frequency: list[float] | torch.Tensor, damping: list[float] | torch.Tensor | float = 10.0) -> ModalBank:
    frequency = torch.as_tensor(frequency, dtype=torch.float64)
    return ModalBank(frequency, torch.as_tensor(damping, dtype=torch.float64).expand(len(frequency)).clone())


def random_bank(modes: int, *, seed: int, pitch: float = 0.0, decay: float = 0.0) -> ModalBank:
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(2, modes, generator=generator, dtype=torch.float64)
    return bank(2 ** (9 + 4 * drawn[0] + pitch), 2 ** (3 + drawn[1] + decay))


def shift(features, first: ModalBank, second: ModalBank) -> float:
    return float(np.linalg.norm(features(first) - features(second)))


@pytest.mark.parametrize("modes", [1, 7, 200])
def test_a_set_an_octave_higher_is_one_away(modes):
    low, high = random_bank(modes, seed=0), random_bank(modes, seed=0, pitch=1.0)
    assert shift(pitches, low, high) == pytest.approx(1.0, abs=1e-12)


def test_twice_the_damping_is_one_away_and_no_other_pitch():
    slow, fast = random_bank(9, seed=0), random_bank(9, seed=0, decay=1.0)
    assert shift(rings, slow, fast) == pytest.approx(1.0, abs=1e-12)
    assert shift(pitches, slow, fast) == 0.0


def test_dampings_are_taken_where_their_pitch_is():
    # d = 3 (f / 1000)^2 is a straight line of slope 2; inside a dense set, its mean around a pitch is its value there.
    frequency = 2 ** torch.linspace(5, 16, 2000, dtype=torch.float64)
    curve = rings(bank(frequency, 3.0 * (frequency / 1000) ** 2))[32:] * math.sqrt(15)
    expected = math.log2(3.0) + 2 * (np.linspace(math.log2(125.0), math.log2(16000.0), 15) - math.log2(1000.0))
    assert np.abs(curve - expected)[2:-4] == pytest.approx(0.0, abs=0.01)


def test_far_from_every_mode_the_nearest_one_counts():
    curve = rings(bank([15.0, 16.0], [4.0, 32.0]))[32:] * math.sqrt(15)
    assert curve[-1] == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("features", FEATURES.values(), ids=FEATURES)
def test_neither_order_nor_number_of_modes_matters(features):
    one = random_bank(20, seed=1)
    turned = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    assert shift(features, one, bank(one.frequency[turned], one.damping[turned])) < 1e-12
    # Every mode a thousand times instead of once: the quantiles are interpolated a little otherwise.
    dense = bank(2 ** (9 + 4 * torch.linspace(0, 1, 100)), 8.0)
    assert shift(features, dense, bank(dense.frequency.repeat(9), 8.0)) < 0.02


@pytest.mark.parametrize("features", FEATURES.values(), ids=FEATURES)
def test_sets_that_are_none_are_refused(features):
    with raises(EvaluationError, name="bank", value=0):
        features(bank([]))
    with raises(EvaluationError, row=1, name="frequency", value=0.0):
        features(bank([100.0, 0.0]))
    with raises(EvaluationError, row=0, name="damping"):
        features(bank([100.0], math.nan))


def labelled(count: int = 8) -> tuple[list[ModalBank], list[str]]:
    """Return deep dull objects, and bright ones three octaves above them."""
    low = [random_bank(20 + row, seed=row, decay=2.0) for row in range(count)]
    high = [random_bank(30 - row, seed=50 + row, pitch=3.0) for row in range(count)]
    return [*low, *high], ["wood"] * count + ["glass"] * count


@pytest.fixture(scope="module")
def space() -> MaterialSpace:
    # Importing it compiles for many seconds, which only its embeddings need.
    if importlib.util.find_spec("umap") is None:
        pytest.skip("needs pip install 'avmsf[eval]'")
    return MaterialSpace.of(*labelled(), seed=3)


@pytest.mark.slow
def test_an_objects_like_is_near_and_its_opposite_far(space):
    wood, glass = random_bank(25, seed=99), random_bank(25, seed=98, pitch=3.0)
    assert space.distance(space.place(wood), "wood") < 0.5 * space.distance(space.place(wood), "glass")
    assert space.distance(space.place(glass), "glass") < 0.5 * space.distance(space.place(glass), "wood")
    assert space.nearest_neighbor_accuracy() == 1.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_space(space):
    again = MaterialSpace.of(*labelled(), seed=3)
    assert np.array_equal(again.embedding, space.embedding)
    other = random_bank(25, seed=99)
    assert np.array_equal(again.place(other), space.place(other))
    # Placing others in between changes nothing.
    space.place(random_bank(10, seed=97))
    assert np.array_equal(again.place(other), space.place(other))
    assert not np.array_equal(MaterialSpace.of(*labelled(), seed=4).embedding, space.embedding)


def test_objects_that_make_no_space_are_refused():
    banks, materials = labelled()
    with raises(EvaluationError, name="materials", value=15):
        MaterialSpace.of(banks, materials[1:])
    with raises(EvaluationError, name="mode_sets", value=(4, 1)):
        MaterialSpace.of(banks[:4], materials[:4])
    with raises(EvaluationError, name="bowl", value=0):
        MaterialSpace.of([*banks, bank([])], [*materials, "wood"], names=[*map(str, range(16)), "bowl"])
    with raises(EvaluationError, name="material", value="steel"):
        MaterialSpace.of(banks, materials).center("steel")


def test_a_missing_package_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "umap", None)
    with raises(EvaluationError, name="umap-learn") as caught:
        _ = MaterialSpace.of(*labelled()).embedding
    assert "pip install 'avmsf[eval]'" in str(caught.value)
