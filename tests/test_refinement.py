"""Linear gain fields on their way through the end-to-end stage: where they start, what holds them, what they become."""

from dataclasses import replace

import pytest
import torch

from avmsf.field.doubt import widening
from avmsf.field.fit import Progress, fit, gain_case
from avmsf.field.recipes import SHARED, ThinPlate
from avmsf.field.refinement import LinearGains, RefinedGains
from avmsf.modal.extraction.extract import extract
from made_fields import BANK, LINEAR, blows, places
from plate_field import QUICK, plate_extraction, plate_features, plate_impacts

every_field = pytest.mark.parametrize("name", LINEAR)


def at_contacts(field: LinearGains) -> torch.Tensor:
    """Return both parts of the gains at the field's own contacts, struck as they were."""
    known = field.at(field.contacts, getattr(field, "directions", None))
    return torch.stack([known.mean, known.quadrature], dim=2)


def read(gains: RefinedGains) -> torch.Tensor:
    known = gains.read(torch.arange(len(gains.start)))
    return torch.stack([known.mean, known.quadrature], dim=2).detach()


def moved(field: LinearGains, *, by: float = 1e-3) -> RefinedGains:
    gains = RefinedGains(field, BANK)
    with torch.no_grad():
        gains.shift.normal_(std=by, generator=torch.Generator().manual_seed(0))
    return gains


@every_field
def test_the_smoother_makes_the_gains_at_the_contacts_of_those_measured(name):
    field = LINEAR[name]()
    assert isinstance(field, LinearGains)
    contacts, modes, _ = field.values.shape
    smoother = field.smoother()
    assert smoother.shape == (modes, 2, contacts, contacts)
    for mode in range(modes):
        for part in range(2):
            found = smoother[mode, part] @ field.values[:, mode, part]
            expected = at_contacts(field)[:, mode, part].double()
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-6 * float(field.values.abs().max()))


@every_field
def test_gains_are_linear_in_those_measured(name):
    field, other = LINEAR[name](), LINEAR[name]().values.flip(0)
    asked = places(6, seed=4)
    one, two, both = (
        field.with_values(values).at(asked, blows(asked, seed=5)).mean
        for values in (field.values, other, 2 * field.values - 3 * other)
    )
    torch.testing.assert_close(both, 2 * one - 3 * two, rtol=0, atol=1e-5 * float(both.abs().max()))


@every_field
def test_it_starts_where_the_field_is_and_nothing_speaks_against_that(name):
    field = LINEAR[name]()
    gains = RefinedGains(field, BANK)
    torch.testing.assert_close(read(gains), at_contacts(field), rtol=0, atol=1e-6 * float(field.values.abs().max()))
    assert float(gains.penalty().detach()) == 0.0
    asked = places(6, seed=4)
    unmoved = gains.finished(torch.arange(len(BANK)))
    assert torch.equal(unmoved.at(asked).mean, field.at(asked).mean)
    assert torch.equal(unmoved.values, field.values)


@every_field
def test_the_finished_field_has_the_moved_gains(name):
    field, order = LINEAR[name](), torch.tensor([3, 1, 4, 0, 2])
    gains = moved(field)
    finished = gains.finished(order)
    difference = float((read(gains) - at_contacts(field)).abs().max())
    assert difference > 1e-3 * float(field.values.abs().max())
    # Float32 in the one, float64 in the other.
    torch.testing.assert_close(at_contacts(finished), read(gains)[:, order], rtol=0, atol=1e-4 * difference)
    assert torch.equal(finished.contacts, field.contacts)
    rows = torch.tensor([2, 0])
    torch.testing.assert_close(gains.read(rows).mean, gains.read(torch.arange(4)).mean[rows])


@every_field
def test_a_gain_that_moves_by_its_standard_error_costs_by_its_modes_energy(name):
    """The penalty is that of a Gaussian prior: a tenth of half the squared shift in standard errors."""
    field = LINEAR[name]()
    energy = field.values.square().sum((0, 2)) / BANK.damping
    share = energy / energy.sum()
    for gains in (moved(field), moved(field, by=1e-2)):
        shift = (gains.finished(torch.arange(len(BANK))).values - field.values) / field.noise
        expected = 0.05 * float((shift.square().mean((0, 2)) * share).sum())
        assert expected > 0
        assert float(gains.penalty().detach()) == pytest.approx(expected, rel=1e-4)


@every_field
def test_a_state_brings_it_back(name):
    gains = moved(LINEAR[name]())
    other = RefinedGains(LINEAR[name](), BANK)
    other.load_state_dict(gains.state_dict())
    assert torch.equal(read(other), read(gains))
    # The shifts alone are moved by training, and are no matrix that would decay.
    assert [(key, each.ndim) for key, each in gains.named_parameters()] == [("shift", 3)]


CONFIG = replace(QUICK, steps=20, learning_rate=3e-3)


def test_a_fit_without_steps_is_the_recipes_own_field():
    impacts, features = plate_impacts(), plate_features()
    modes, config = plate_extraction(impacts), replace(CONFIG, steps=0)
    case = gain_case(impacts, features, modes, config)
    field = fit(impacts, features, modes, config, gains=ThinPlate())
    own = ThinPlate().start(case, SHARED).finished(torch.arange(len(modes.bank)))
    asked = plate_features(40).points
    assert torch.equal(field.gains(asked), own.at(asked).mean)
    assert torch.equal(field.bank.frequency, modes.bank.frequency)
    # Passing through the gains that were extracted, turned to the common phase.
    both = torch.stack([field.known(impacts.contacts).mean, field.known(impacts.contacts).quadrature], dim=2)
    torch.testing.assert_close(both.double(), case.parts, rtol=0, atol=1e-5 * float(case.parts.abs().max()))
    assert field.origin.report == {
        "gains": "spline",
        "kernel": "thin plate",
        "smoothing": 0.0,
        "damping": "shared",
        "validated": False,
    }


def test_end_to_end_the_loss_falls_and_gains_move_no_farther_than_doubt_allows():
    impacts, told = plate_impacts(), list[Progress]()
    modes = plate_extraction(impacts)
    wrong = replace(modes, gains=modes.gains * (1 + 0.1 * torch.tensor([1.0, -1.0]).repeat(6)[:, None]))
    field = fit(impacts, plate_features(), wrong, CONFIG, gains=ThinPlate(), progress=told.append)
    # No warm-up: nothing has to be learnt first.
    assert [(each.stage, each.step, each.steps, each.warmup) for each in told] == [
        ("fit", step + 1, 20, 0) for step in range(20)
    ]
    assert told[-1].loss < 0.9 * told[0].loss
    shift = field.known(impacts.contacts).mean.double() - wrong.gains
    truth = modes.gains.double() - wrong.gains
    assert float(shift.abs().max()) > 0
    # Nearer to the gains that the sounds have: .73 of the squared error was left.
    assert float((shift - truth).square().sum()) < 0.8 * float(truth.square().sum())


@every_field
def test_a_field_judges_itself_by_gains_whatever_their_signs_and_their_modes_turns(name):
    field = LINEAR[name]()
    contacts, modes, _ = field.values.shape
    generator = torch.Generator().manual_seed(3)
    off = field.values + 0.1 * field.noise * torch.randn(contacts, modes, 2, generator=generator, dtype=torch.float64)
    signs = torch.where(torch.arange(contacts) % 3 == 0, -1.0, 1.0)
    turn = torch.polar(torch.ones(modes).double(), torch.linspace(-0.5, 0.5, modes).double())
    turned = torch.view_as_real(torch.view_as_complex(off.contiguous()) * turn) * signs[:, None, None]
    order = torch.arange(modes)
    plain = RefinedGains(field, BANK).judged(order, off)
    judged = RefinedGains(field, BANK, signs=signs).judged(order, turned)
    torch.testing.assert_close(judged.measured, plain.measured)
    torch.testing.assert_close(judged.left_out(), plain.left_out())
    # Without signs a third of the gains would be taken for their opposites.
    wrong = RefinedGains(field, BANK).judged(order, turned)
    assert float((wrong.measured - field.values).norm()) > 5.0 * float((plain.measured - field.values).norm())


def test_a_spline_is_as_sure_whichever_side_was_struck():
    train = plate_impacts()
    assert train.directions is not None
    sides = torch.where(torch.arange(len(train)) % 2 == 0, -1.0, 1.0)[:, None]
    turned = replace(train, sounds=sides * train.sounds, directions=sides * train.directions)
    one, other = (
        widening(fit(each, plate_features(), extract(each), replace(QUICK, steps=3), gains=ThinPlate()))
        for each in (train, turned)
    )
    # The noise that is drawn beside the modes does not turn with them.
    assert other == pytest.approx(one, rel=0.15)
