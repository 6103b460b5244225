"""What counts as a mode: chance, candidates, doubles, selection and pruning."""

import math

import pytest
import scipy.stats
import torch
from torch import Tensor

from avmsf.modal.extraction.extract import extract_sounds
from avmsf.modal.extraction.finders import HighResolution, Selection, chance_ratio, choose, merge
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import gram, poles_of
from avmsf.modal.modes import ModalBank, synthesize

RATE = 8000.0
SAMPLES = 6000


def bank_of(frequency: list[float], damping: list[float]) -> ModalBank:
    return ModalBank(torch.tensor(frequency, dtype=torch.float64), torch.tensor(damping, dtype=torch.float64))


TRUTH = bank_of([300.0, 700.0, 703.0, 1500.0, 2900.0], [5.0, 6.0, 7.0, 30.0, 80.0])


def record(bank: ModalBank, *, noise: float = 0.0, contacts: int = 4, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    gains = torch.randn(contacts, len(bank), generator=generator, dtype=torch.float64)
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=SAMPLES, sample_rate=RATE)
    return sounds + noise * torch.randn(contacts, SAMPLES, generator=generator, dtype=torch.float64)


def selection(sounds: Tensor, *, noise: float = 1e-3) -> Selection:
    return Selection(sounds, torch.full((len(sounds), 33), noise**2, dtype=torch.float64), RATE, 6.0, 50)


def select(sounds: Tensor, found: ModalBank, *, noise: float = 1e-3) -> ModalBank:
    chosen = selection(sounds, noise=noise)
    return chosen.select(bank_of([], []), found, chosen.measure(found), range_db=60.0)


def with_others(frequency: list[float], damping: list[float]) -> ModalBank:
    """Return the true modes and others, by frequency."""
    return merge(TRUTH.join(bank_of(frequency, damping)), duration=0.75)


@pytest.mark.parametrize("contacts", [1, 2, 8, 100])
def test_chance_is_the_tail_of_chi_squared(contacts: int):
    threshold = chance_ratio(contacts, trials=10_000)
    assert scipy.stats.chi2.sf(threshold * 2 * contacts, 2 * contacts) == pytest.approx(1e-5, rel=1e-6)


def test_doubles_are_merged_and_neighbors_kept():
    bank = merge(bank_of([700.0, 300.0, 700.0001, 703.0, 700.0], [6.0, 5.0, 6.001, 7.0, 60.0]), duration=1.0)
    assert bank.frequency.tolist() == [300.0, 700.0, 700.0, 703.0]
    assert sorted(bank.damping.tolist()) == [5.0, 6.0, 7.0, 60.0]


# What the sounds do not have, and what only leaks from a neighbor.
@pytest.mark.parametrize(
    ("others", "noise"),
    [
        (([120.0, 500.0, 1100.0, 2000.0, 3500.0], [5.0, 8.0, 30.0, 9.0, 50.0]), 1e-3),
        (([302.0, 1510.0], [8.0, 50.0]), 0.03),
    ],
)
def test_selection_takes_the_modes_from_among_the_rest(others: tuple[list[float], list[float]], noise: float):
    chosen = select(record(TRUTH, noise=noise), with_others(*others), noise=noise)
    assert chosen.frequency.tolist() == TRUTH.frequency.tolist()
    assert chosen.damping.tolist() == TRUTH.damping.tolist()


def test_selection_among_hundreds_spans_its_chunks():
    chosen = select(record(TRUTH, noise=1e-3), with_others(torch.linspace(100.5, 3900.5, 400).tolist(), [4.0] * 400))
    for pitch in TRUTH.frequency.tolist():
        assert pitch in chosen.frequency


def test_pruning_takes_one_of_two_that_are_equal():
    chosen = selection(record(TRUTH, noise=1e-3))
    kept = chosen.prune(with_others([300.0, 1500.0], [5.4, 33.0]), range_db=60.0)
    torch.testing.assert_close(kept.frequency, TRUTH.frequency)
    assert len(chosen.prune(bank_of([300.0, 300.0], [5.0, 5.0]), range_db=60.0)) == 1


def test_pruning_nothing_but_noise_leaves_nothing():
    sounds = torch.randn(4, SAMPLES, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for bank in (TRUTH, bank_of([], [])):
        assert len(selection(sounds, noise=1.0).prune(bank, range_db=60.0)) == 0
    assert math.isfinite(chance_ratio(1, trials=1))


def test_pruning_leaves_no_cancelling_modes():
    sounds = record(bank_of([700.0], [30.0]), noise=1e-4)
    crowd = bank_of([699.0, 700.0, 701.0, 702.0], [28.0, 30.0, 35.0, 31.0])
    kept = selection(sounds, noise=1e-6).prune(crowd, range_db=60.0)
    _, apart = NormalEquations.of(sounds, poles_of(kept, RATE)).lost_without()
    assert float(apart.min()) >= 0.01
    assert 700.0 in kept.frequency


def test_range_leaves_faint_modes_out():
    gains = torch.tensor([[1.0, 10 ** (-50 / 20), 10 ** (-70 / 20)]], dtype=torch.float64)
    bank = bank_of([300.0, 900.0, 2000.0], [10.0, 10.0, 10.0])
    sounds = synthesize(gains, bank.frequency, bank.damping, samples=SAMPLES, sample_rate=RATE)
    sounds = sounds + 1e-6 * torch.randn(sounds.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for range_db, kept in ((60.0, [300.0, 900.0]), (80.0, [300.0, 900.0, 2000.0])):
        found = extract_sounds(sounds, sample_rate=RATE, method=HighResolution(range_db=range_db)).bank
        assert found.frequency.tolist() == pytest.approx(kept, abs=0.1)


def explained(sounds: Tensor, bank: ModalBank) -> float:
    return NormalEquations.of(sounds, poles_of(bank, RATE)).explained() if len(bank) else 0.0


@pytest.mark.parametrize("known", [[], [1, 3]])
def test_what_the_chosen_explain_one_after_another_is_what_they_explain_together(known: list[int]):
    sounds = record(TRUTH, noise=1e-3)
    bank = bank_of([299.0, 300.0, 700.0, 703.0, 704.0, 1500.0, 2900.0], [4.0, 5.0, 6.0, 7.0, 9.0, 30.0, 80.0])
    measured = selection(sounds).measure(bank)
    given = torch.zeros(len(bank), dtype=torch.bool)
    given[known] = True
    inner = gram(poles_of(bank, RATE), SAMPLES, power=0)
    energy = choose(inner, *measured, given, significance=6.0, reach=1e-6)
    assert (energy[given] == 0).all()
    alone = bank.take(given)
    taken = (energy > 0) | given
    together = bank.take(taken)
    assert float(energy.sum()) == pytest.approx(explained(sounds, together) - explained(sounds, alone), rel=1e-7)
    # The first to go explains most beside those given, of all.
    gained = [explained(sounds, alone.join(bank.take(row))) - explained(sounds, alone) for row in torch.nonzero(~given)]
    assert float(energy.max()) == pytest.approx(max(gained), rel=1e-7)
    assert int(energy[~given].argmax()) == gained.index(max(gained))
