"""Modes and gains beside true ones, with errors put in by hand."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from avmsf.errors import EvaluationError
from avmsf.evaluation.modal_metrics import ModalRenderer, compare_modes, match_modes
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize
from avmsf.simulate.ground_truth import Truth
from factories.raising import raises

CONTACTS = torch.arange(36, dtype=torch.float64).view(12, 3)


def numbers(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def truth() -> Truth:
    generator = torch.Generator().manual_seed(0)
    gains = torch.complex(*torch.randn(2, 12, 4, generator=generator, dtype=torch.float64))
    frequency = numbers(400, 900, 1700, 4000)
    return Truth(frequency, numbers(4, 8, 20, 40), gains, tuple(f"{row}.wav" for row in range(12)))


@dataclass(frozen=True, eq=False)
class Modes:
    bank: ModalBank
    table: torch.Tensor

    def complex_gains(self, contacts: torch.Tensor, *, directions: torch.Tensor | None = None) -> torch.Tensor:
        return self.table[: len(contacts)]


def rendered(amplitudes: torch.Tensor, frequency: torch.Tensor | None = None) -> Modes:
    bank = ModalBank(truth().frequency if frequency is None else frequency, truth().damping)
    return Modes(bank, amplitudes)


def amplitudes() -> torch.Tensor:
    return truth().amplitudes


def test_the_truth_itself_is_perfect():
    scores = compare_modes(rendered(amplitudes()), CONTACTS, truth())
    assert isinstance(rendered(amplitudes()), ModalRenderer)
    figures = scores.figures()
    assert figures["gain_error"] == pytest.approx(0.0, abs=1e-7)
    assert figures["mac"] == pytest.approx(1.0, rel=1e-12)
    exact = {key: figures[key] for key in ("frequency_error", "damping_error", "false_modes", "false_energy")}
    assert exact == {"frequency_error": 0.0, "damping_error": 0.0, "false_modes": 0.0, "false_energy": 0.0}
    assert figures["found"] == pytest.approx(1.0, rel=1e-12)


def test_weights_are_the_energies_of_the_sounds():
    one = truth()
    rate, energies = 48000.0, []
    for mode in range(4):
        sounds = synthesize(
            one.gains[:, mode : mode + 1],
            one.frequency[mode : mode + 1],
            one.damping[mode : mode + 1],
            samples=96000,
            sample_rate=rate,
        )
        energies.append(float(sounds.double().square().sum() / rate))
    share = numbers(*energies) / sum(energies)
    # The mean of a sine's square is a half but for a term of damping over angular frequency, at most .003 here.
    weight = compare_modes(rendered(amplitudes()), CONTACTS, one).weight
    assert torch.allclose(weight, share, rtol=5e-3)


def test_a_modes_phase_and_a_contacts_polarity_are_free():
    phases = torch.exp(1j * numbers(0.3, 2.0, -1.0, 3.1))
    polarity = torch.where(torch.arange(12) % 3 == 0, -1.0, 1.0).double()
    figures = compare_modes(rendered(polarity[:, None] * amplitudes() * phases), CONTACTS, truth()).figures()
    assert figures["gain_error"] == pytest.approx(0.0, abs=1e-7)
    assert figures["mac"] == pytest.approx(1.0, rel=1e-9)


def test_what_a_listener_hears_is_not_free():
    # The sign of one mode at half of the contacts: their sum cancels for that mode.
    wrong = amplitudes()
    wrong[:6, 0] *= -1
    one = truth()
    single = Truth(one.frequency[:1], one.damping[:1], one.gains[:, :1], one.names)
    assert compare_modes(rendered(wrong), CONTACTS, truth()).figures()["mac"] < 0.9
    # Of a single mode it is nothing but polarity.
    alone = Modes(ModalBank(single.frequency, single.damping), wrong[:, :1])
    assert compare_modes(alone, CONTACTS, single).figures()["mac"] == pytest.approx(1.0, rel=1e-9)


@dataclass(frozen=True, eq=False)
class Directed(Modes):
    """Gains in proportion to the direction's third coordinate."""

    def complex_gains(self, contacts: torch.Tensor, *, directions: torch.Tensor | None = None) -> torch.Tensor:
        assert directions is not None
        return self.table[: len(contacts)] * directions[:, 2:]


def test_gains_are_compared_along_the_impacts_directions():
    along = torch.linspace(0.1, 1.0, 12, dtype=torch.float64)
    directions = torch.stack([(1 - along.square()).sqrt(), torch.zeros_like(along), along], dim=1)
    renderer = Directed(rendered(amplitudes()).bank, amplitudes())
    one = replace(truth(), gains=truth().gains * along[:, None])
    figures = compare_modes(renderer, CONTACTS, one, directions=directions).figures()
    assert figures["gain_error"] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.1, 2.0])
def test_a_level_is_a_gain_error_and_leaves_the_mac(factor):
    figures = compare_modes(rendered(factor * amplitudes()), CONTACTS, truth()).figures()
    assert figures["gain_error"] == pytest.approx(abs(factor - 1), rel=1e-9)
    assert figures["mac"] == pytest.approx(1.0 if factor else 0.0, rel=1e-9)


def test_error_at_right_angles_follows_pythagoras():
    one = truth()
    g = one.gains.real
    # Sines alone, in both: a pattern orthogonal to the true one over contacts, of half its norm, added to every mode.
    other = torch.randn(12, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    other -= g * ((g * other).sum(0) / g.square().sum(0))
    other *= 0.5 * g.norm(dim=0) / other.norm(dim=0)
    sines = Modes(ModalBank(one.frequency, one.damping), -1j * (g + other))
    # cos^2 of the angle between them is 1 / (1 + 1/4).
    scores = compare_modes(sines, CONTACTS, replace(one, gains=one.gains.real + 0j))
    assert torch.allclose(scores.gain_error, torch.full((4,), 0.5, dtype=torch.float64), rtol=1e-9)
    assert torch.allclose(scores.mac, torch.full((4,), 0.8, dtype=torch.float64), rtol=1e-9)


def test_unrelated_gains_have_a_mac_near_one_over_contacts():
    generator = torch.Generator().manual_seed(3)
    contacts, modes = 200, 30
    table = torch.randn(4, contacts, modes, generator=generator, dtype=torch.float64)
    bank = ModalBank(torch.linspace(300, 9000, modes, dtype=torch.float64), torch.full((modes,), 10.0).double())
    one = Truth(bank.frequency, bank.damping, torch.complex(table[0], table[1]), ("",) * contacts)
    places = torch.zeros(contacts, 3, dtype=torch.float64)
    mac = compare_modes(Modes(bank, torch.complex(table[2], table[3])), places, one).figures()["mac"]
    # 1 / 200 for complex numbers; polarities chosen at best leave a little more.
    assert 1 / 200 < mac < 5 / 200


def test_frequencies_and_dampings_are_in_proportion():
    one = truth()
    bank = ModalBank(one.frequency * 1.001, one.damping * 2)
    scores = compare_modes(Modes(bank, one.amplitudes), CONTACTS, one)
    assert torch.allclose(scores.frequency_error, torch.full((4,), 1e-3, dtype=torch.float64), rtol=1e-9)
    assert scores.figures()["frequency_error"] == pytest.approx(1e-3, rel=1e-9)
    assert scores.figures()["damping_error"] == pytest.approx(math.log(2), rel=1e-12)


def test_missing_modes_count_as_silence_and_others_as_false():
    one = truth()
    frequency = numbers(400, 900, 1700, 3900)
    scores = compare_modes(rendered(amplitudes(), frequency), CONTACTS, one)
    assert scores.match.tolist() == [0, 1, 2, -1]
    missing = float(scores.weight[3])
    figures = scores.figures()
    assert figures["found"] == pytest.approx(1 - missing, rel=1e-12)
    assert figures["mac"] == pytest.approx(1 - missing, rel=1e-9)
    assert figures["gain_error"] == pytest.approx(math.sqrt(missing), rel=1e-9)
    assert figures["false_modes"] == 1.0
    # The false mode has the amplitudes and the damping of the one that is missing.
    assert figures["false_energy"] == pytest.approx(missing, rel=1e-9)
    assert math.isnan(float(scores.frequency_error[3]))
    assert figures["frequency_error"] == 0.0


def test_a_method_that_finds_nothing_has_no_frequency_error():
    none = Modes(ModalBank(numbers(), numbers()), torch.zeros(12, 0, dtype=torch.complex128))
    figures = compare_modes(none, CONTACTS, truth()).figures()
    assert (figures["found"], figures["gain_error"], figures["mac"]) == (0.0, pytest.approx(1.0), 0.0)
    assert figures["frequency_error"] is None
    assert figures["damping_error"] is None


def test_a_modes_tolerance_is_its_width_or_a_part_of_its_frequency():
    true = ModalBank(numbers(1000, 5000), numbers(10 * math.pi, math.pi))
    # 10 Hz is the first mode's half-power width; 0.2 % of the second is 10 Hz and its width 1 Hz.
    for offset, expected in ((9.9, [0, 1]), (10.1, [-1, -1])):
        found = ModalBank(true.frequency + offset, true.damping)
        assert match_modes(found, true).tolist() == expected


def test_a_doublet_is_matched_in_order_and_a_mode_once():
    true = ModalBank(numbers(1681, 1684), numbers(9, 9))
    pair = match_modes(ModalBank(numbers(1682.6, 1685.5), numbers(9, 9)), true)
    # 1682.6 Hz is nearer to the second, but then the other two would go without.
    assert pair.tolist() == [0, 1]
    # Two pairs would be possible here too, both of them bad ones; one is exact.
    assert match_modes(ModalBank(numbers(1684.0, 1687.3), numbers(9, 9)), true).tolist() == [-1, 0]
    assert match_modes(ModalBank(numbers(1683.0), numbers(9)), true).tolist() == [-1, 0]


def test_what_cannot_be_compared_is_refused():
    one, good = truth(), rendered(amplitudes())
    with raises(EvaluationError, name="truth", value=12):
        compare_modes(good, CONTACTS[:5], one)
    with raises(EvaluationError, name="predicted", value=[12, 3]):
        compare_modes(Modes(good.bank, one.amplitudes[:, :3]), CONTACTS, one)
    with raises(EvaluationError, name="truth", value=0.0):
        compare_modes(good, CONTACTS, replace(one, gains=0 * one.gains))
    broken = amplitudes()
    broken[3, 2] = math.nan
    with raises(EvaluationError, name="predicted", row=3):
        compare_modes(rendered(broken), CONTACTS, one)
