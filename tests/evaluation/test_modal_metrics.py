"""Metrics of modes, and their embedding."""

import importlib.util
import math
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.modal_metrics import common_delay, compare_modes, match_modes, truth_at, truth_from_first_sample
from avmsf.evaluation.mode_embedding import FEATURES, MaterialSpace, check_materials, pitches, pitches_and_dampings
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.simulate.ground_truth import Truth
from avmsf.simulate.simulation import recorded
from factories.raising import raises

RATE, COUNT = 8000.0, 12
CONTACTS = torch.arange(36, dtype=torch.float64).view(COUNT, 3)


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def truth_of(frequency: torch.Tensor, damping: torch.Tensor) -> Truth:
    generator = torch.Generator().manual_seed(0)
    gains = torch.complex(*torch.randn(2, COUNT, len(frequency), generator=generator, dtype=torch.float64))
    return Truth(frequency, damping, gains, tuple(f"{row}.wav" for row in range(COUNT)))


TRUTH = truth_of(numbers(400, 900, 1700, 4000), numbers(4, 8, 20, 40))
AMPLITUDES = TRUTH.amplitudes


@dataclass(frozen=True, eq=False)
class Modes:
    bank: ModalBank
    table: torch.Tensor

    def complex_gains(self, contacts: torch.Tensor, *, directions: torch.Tensor | None = None) -> torch.Tensor:
        return self.table[: len(contacts)]


def figures(amplitudes: torch.Tensor, frequency: torch.Tensor | None = None) -> dict[str, float]:
    bank = ModalBank(TRUTH.frequency if frequency is None else frequency, TRUTH.damping)
    return compare_modes(Modes(bank, amplitudes), CONTACTS, TRUTH)


def weights() -> torch.Tensor:
    """Return each true mode's part of the energy: what is found of it alone."""
    banks = (ModalBank(TRUTH.frequency[mode, None], TRUTH.damping[mode, None]) for mode in range(4))
    return numbers(*(compare_modes(Modes(bank, AMPLITUDES[:, :1]), CONTACTS, TRUTH)["found"] for bank in banks))


def test_weights_are_the_energies_of_the_sounds():
    energies = []
    for mode in range(4):
        one = slice(mode, mode + 1)
        sounds = synthesize(
            TRUTH.gains[:, one], TRUTH.frequency[one], TRUTH.damping[one], samples=96000, sample_rate=48000.0
        )
        energies.append(float(sounds.double().square().sum()))
    # The mean of a sine's square is a half but for a term of damping over angular frequency, at most .003 here.
    assert torch.allclose(weights(), numbers(*energies) / sum(energies), rtol=5e-3)


def test_a_modes_phase_and_a_contacts_polarity_are_free_and_no_other_sign():
    phases = torch.exp(1j * numbers(0.3, 2.0, -1.0, 3.1))
    polarity = torch.where(torch.arange(COUNT) % 3 == 0, -1.0, 1.0).double()
    found = figures(polarity[:, None] * AMPLITUDES * phases)
    assert found["gain_error"] == pytest.approx(0.0, abs=1e-7)
    assert found["mac"] == pytest.approx(1.0, rel=1e-9)
    assert found["found"] == pytest.approx(1.0, rel=1e-12)
    # The sign of one mode at half of the contacts: their sum cancels for that mode.
    wrong = AMPLITUDES.clone()
    wrong[:6, 0] *= -1
    assert figures(wrong)["mac"] < 0.9
    # Of a single mode it is only polarity.
    single = Truth(TRUTH.frequency[:1], TRUTH.damping[:1], TRUTH.gains[:, :1], TRUTH.names)
    alone = Modes(ModalBank(single.frequency, single.damping), wrong[:, :1])
    assert compare_modes(alone, CONTACTS, single)["mac"] == pytest.approx(1.0, rel=1e-9)


@dataclass(frozen=True, eq=False)
class Directed(Modes):
    """Gains in proportion to the direction's third coordinate."""

    def complex_gains(self, contacts: torch.Tensor, *, directions: torch.Tensor | None = None) -> torch.Tensor:
        assert directions is not None
        return self.table[: len(contacts)] * directions[:, 2:]


def test_gains_are_compared_along_the_impacts_directions():
    along = torch.linspace(0.1, 1.0, COUNT, dtype=torch.float64)
    directions = torch.stack([(1 - along.square()).sqrt(), torch.zeros_like(along), along], dim=1)
    renderer = Directed(ModalBank(TRUTH.frequency, TRUTH.damping), AMPLITUDES)
    one = replace(TRUTH, gains=TRUTH.gains * along[:, None])
    found = compare_modes(renderer, CONTACTS, one, directions=directions)
    assert found["gain_error"] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.1, 2.0])
def test_a_level_is_a_gain_error_and_leaves_the_mac(factor):
    found = figures(factor * AMPLITUDES)
    assert found["gain_error"] == pytest.approx(abs(factor - 1), rel=1e-9)
    assert found["mac"] == pytest.approx(1.0 if factor else 0.0, rel=1e-9)


def test_error_at_right_angles_follows_pythagoras():
    true = TRUTH.gains.real
    # Sines alone, in both: a pattern orthogonal to the true one over contacts, of half its norm, added to every mode.
    other = torch.randn(COUNT, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    other -= true * ((true * other).sum(0) / true.square().sum(0))
    other *= 0.5 * true.norm(dim=0) / other.norm(dim=0)
    sines = Modes(ModalBank(TRUTH.frequency, TRUTH.damping), -1j * (true + other))
    found = compare_modes(sines, CONTACTS, replace(TRUTH, gains=true + 0j))
    assert found["gain_error"] == pytest.approx(0.5, rel=1e-9)
    # cos^2 of the angle between them is 1 / (1 + 1/4).
    assert found["mac"] == pytest.approx(0.8, rel=1e-9)


def test_unrelated_gains_have_a_mac_near_one_over_contacts():
    contacts, modes = 200, 30
    table = torch.randn(4, contacts, modes, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    bank = ModalBank(torch.linspace(300, 9000, modes, dtype=torch.float64), torch.full((modes,), 10.0).double())
    one = Truth(bank.frequency, bank.damping, torch.complex(table[0], table[1]), ("",) * contacts)
    found = compare_modes(Modes(bank, torch.complex(table[2], table[3])), torch.zeros(contacts, 3).double(), one)
    # 1 / 200 for complex numbers; polarities chosen at best leave a little more.
    assert 1 / 200 < found["mac"] < 5 / 200


def test_missing_modes_count_as_silence():
    found, missing = figures(AMPLITUDES, numbers(400, 900, 1700, 3900)), float(weights()[3])
    assert found["found"] == pytest.approx(1 - missing, rel=1e-12)
    assert found["mac"] == pytest.approx(1 - missing, rel=1e-9)
    assert found["gain_error"] == pytest.approx(math.sqrt(missing), rel=1e-9)
    none = Modes(ModalBank(numbers(), numbers()), torch.zeros(COUNT, 0, dtype=torch.complex128))
    found = compare_modes(none, CONTACTS, TRUTH)
    assert (found["found"], found["gain_error"], found["mac"]) == (0.0, pytest.approx(1.0), 0.0)


def test_a_modes_tolerance_is_its_width_or_a_part_of_its_frequency():
    true = ModalBank(numbers(1000, 5000), numbers(10 * math.pi, math.pi))
    # 10 Hz is the first mode's half-power width; 0.2 % of the second is 10 Hz and its width 1 Hz.
    for offset, expected in ((9.9, [0, 1]), (10.1, [-1, -1])):
        assert match_modes(ModalBank(true.frequency + offset, true.damping), true).tolist() == expected


def test_a_doublet_is_matched_in_order_and_a_mode_once():
    true = ModalBank(numbers(1681, 1684), numbers(9, 9))
    # 1682.6 Hz is nearer to the second, but then the other two would go without.
    assert match_modes(ModalBank(numbers(1682.6, 1685.5), numbers(9, 9)), true).tolist() == [0, 1]
    # Two pairs would be possible here too, both of them bad ones; one is exact.
    assert match_modes(ModalBank(numbers(1684.0, 1687.3), numbers(9, 9)), true).tolist() == [-1, 0]
    assert match_modes(ModalBank(numbers(1683.0), numbers(9)), true).tolist() == [-1, 0]


def test_the_truth_of_some_recordings_has_their_own_frequencies():
    shifts = 1e-3 * torch.randn(COUNT, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shifted, rows = replace(TRUTH, shifts=shifts), [7, 0, 3]
    some = truth_at(shifted, tuple(TRUTH.names[row] for row in rows)).after(0.01)
    assert torch.equal(some.gains, shifted.after(0.01).gains[rows])


def test_what_cannot_be_compared_is_refused():
    bank, broken = ModalBank(TRUTH.frequency, TRUTH.damping), AMPLITUDES.clone()
    broken[3, 2] = math.nan
    with raises(EvaluationError, name="truth", value=COUNT):
        compare_modes(Modes(bank, AMPLITUDES), CONTACTS[:5], TRUTH)
    with raises(EvaluationError, name="predicted", value=[COUNT, 3]):
        compare_modes(Modes(bank, AMPLITUDES[:, :3]), CONTACTS, TRUTH)
    with raises(EvaluationError, name="truth", value=0.0):
        compare_modes(Modes(bank, AMPLITUDES), CONTACTS, replace(TRUTH, gains=0 * TRUTH.gains))
    with raises(EvaluationError, name="predicted", row=3):
        compare_modes(Modes(bank, broken), CONTACTS, TRUTH)
    with raises(EvaluationError, name="names", value=("x.wav",)):
        truth_at(TRUTH, ("x.wav",))


def struck(modes: int = 5) -> Truth:
    """Return a truth that knows where its recordings start."""
    frequency, damping = numbers(310, 742, 880, 1630, 2900)[:modes], numbers(60, 90, 70, 200, 400)[:modes]
    return replace(truth_of(frequency, damping), starts=torch.zeros(COUNT, dtype=torch.float64))


def heard(truth: Truth, starts: torch.Tensor, *, noise: float = 0.0) -> Impacts:
    """Return recordings whose sounds start at these samples, which may be negative."""
    poles = torch.complex(-truth.damping, 2 * math.pi * truth.frequency)
    sounds = recorded(poles, truth.amplitudes, starts, sample_rate=RATE, samples=2000)
    noises = torch.randn(sounds.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    sounds = sounds + noise * sounds.square().mean().sqrt() * noises
    return Impacts(CONTACTS, sounds.float(), RATE, truth.names)


def late(samples: float) -> torch.Tensor:
    return torch.full((COUNT,), -samples, dtype=torch.float64)


@pytest.mark.parametrize("modes", [1, 5])
@pytest.mark.parametrize("samples", [0.0, 2.3, -3.7, 30.4, -31.8])
def test_the_common_delay_is_recovered_to_a_fraction_of_a_sample(samples: float, modes: int) -> None:
    impacts = heard(struck(modes), late(samples), noise=0.03)
    assert common_delay(struck(modes), impacts) * RATE == pytest.approx(samples, abs=0.05)


def test_of_unequal_delays_it_is_the_one_that_serves_all_best() -> None:
    starts = torch.randn(COUNT, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 5.0
    # Starts spread by one sample: their mean is uncertain by a third of one.
    assert common_delay(struck(), heard(struck(), starts)) * RATE == pytest.approx(-float(starts.mean()), abs=0.7)


@pytest.mark.parametrize("samples", [0.0, 2.3, 40.0])
def test_a_delay_of_all_recordings_changes_no_figure(samples: float) -> None:
    truth = struck()
    impacts, bank = heard(truth, late(samples)), ModalBank(truth.frequency, truth.damping)
    # Amplitudes by least squares of the recordings themselves, too loud by a tenth.
    fitted = Modes(bank, -1.1j * fit_gains(impacts.sounds, bank, sample_rate=RATE))
    found = compare_modes(fitted, CONTACTS, truth_from_first_sample(truth, impacts))
    assert found["gain_error"] == pytest.approx(0.1, abs=1e-3)
    assert found["mac"] == pytest.approx(1.0, abs=1e-3)


def test_a_truth_whose_files_start_with_their_impacts_stays_as_it_is() -> None:
    truth = replace(struck(), starts=None)
    assert truth_from_first_sample(truth, heard(truth, late(2.0))) is truth


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
    assert np.array_equal(again.embedding, space.embedding)
    assert {"umap-learn", "numba", "scikit-learn"} <= space.record()["versions"].keys()
    assert np.array_equal(again.place(random_bank(25, seed=99)), wood)


@pytest.mark.parametrize(
    ("make", "attributes"),
    [
        (lambda: check_materials(["wood"] * 4), {"name": "materials", "value": (4, 1)}),
        (lambda: space_of(*labelled()).embedding, {"name": "umap-learn"}),
    ],
)
def test_what_makes_no_space_is_refused(make, attributes, monkeypatch):
    monkeypatch.setitem(sys.modules, "umap", None)
    with raises(EvaluationError, **attributes):
        make()
