"""How far a field's modes are independent evidence: by how well its own impacts, left out, are found."""

from dataclasses import replace

import pytest
import torch

from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.localization.locator import Locator
from avmsf.localization.prediction import calibrate_tempering
from avmsf.modal.modes import ModalBank
from factories.located_plate import PLATE, mixture_of
from factories.made_fields import sounding
from oracles.plate import plate_modes, plate_surface_points, sample_contacts

HIGHEST = 2500.0


def plate_field(taps: int, *, copies: int = 1, again: int = 1) -> SoundField:
    """Return a field of a plate's gains, each mode `copies` times at other pitches: copies err alike.

    Each place is struck `again` times.
    """
    contacts = sample_contacts(PLATE, taps, generator=torch.Generator().manual_seed(0)).repeat(again, 1)
    modes = plate_modes(PLATE, contacts, highest=HIGHEST)
    higher = torch.linspace(1.0, 1.5, copies, dtype=torch.float64).repeat_interleave(len(modes.frequency))
    bank = ModalBank(modes.frequency.repeat(copies) * higher, modes.damping.repeat(copies))
    values = torch.complex(modes.gains, torch.zeros_like(modes.gains)).repeat(1, copies)
    gains = mixture_of(contacts, values, bank, plate_surface_points(PLATE, 600))
    return sounding(gains, bank=bank, noise=1e-3, samples=4000)


def test_modes_that_err_alike_tell_no_more_than_one_of_them() -> None:
    # Ten times as many modes tell nothing new; what is thought beforehand keeps the factor from a whole tenth.
    assert calibrate_tempering(plate_field(40, copies=10)) < 0.3 * calibrate_tempering(plate_field(40))


def test_levels_and_edits_change_nothing() -> None:
    field = plate_field(20)
    gains = field.gain_field
    louder = replace(field, gain_field=gains.with_values(1000.0 * gains.values))
    assert calibrate_tempering(louder) == calibrate_tempering(field)
    edited = replace(field, gain_field=ScaledGains(gains, torch.full((len(field.bank),), 0.1).double(), 2.0))
    assert calibrate_tempering(edited) == calibrate_tempering(field)


def test_modes_that_an_edit_muted_have_no_say() -> None:
    whole = plate_field(40, copies=10)
    scale = torch.zeros(len(whole.bank), dtype=torch.float64)
    scale[: len(scale) // 10] = 3.0
    muted = replace(whole, gain_field=ScaledGains(whole.gain_field, scale))
    assert calibrate_tempering(muted) == pytest.approx(calibrate_tempering(plate_field(40)), rel=0.2)


def test_fields_with_too_few_contacts_are_trusted_as_fields_are_on_the_whole() -> None:
    few = plate_field(20)
    only = few.gain_field.without(torch.arange(20) >= 2)
    assert calibrate_tempering(replace(few, gain_field=only)) == 1.0
    assert calibrate_tempering(plate_field(1, again=20)) == 1.0


def test_a_contact_in_the_same_place_as_another_is_left_out_with_it() -> None:
    # Predicted from itself, an impact would be found to a hair's breadth.
    assert calibrate_tempering(plate_field(12, again=2)) == pytest.approx(calibrate_tempering(plate_field(12)), rel=0.3)


def test_regions_are_the_wider_the_less_a_mode_counts() -> None:
    field = plate_field(40)
    sound, sizes = field.render(field.gain_field.points[200:201])[0], []
    for factor in (1.0, 0.1, 0.01):
        locator = Locator.of(field)
        vars(locator)["tempering_factor"] = factor
        sizes.append(int(locator.locate(sound).region().sum()))
    assert sizes[0] < sizes[1] < sizes[2]
