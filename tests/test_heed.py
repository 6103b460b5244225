"""How far a field's modes are heeded: by how well its own strikes, left out, are found."""

from dataclasses import replace

import pytest
import torch

from avmsf.field.scaledgains import ScaledGains
from avmsf.field.soundfield import Origin, SoundField
from avmsf.field.thinplategains import thin_plate_gains
from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual
from avmsf.simulate.plate import Plate, plate_modes, plate_surface_points, sample_contacts
from avmsf.tasks.heed import heed_of
from avmsf.tasks.locator import Locator

PLATE = Plate()
HIGHEST = 2500.0


def plate_splines(taps: int, *, copies: int = 1) -> SoundField:
    """Return splines through a plate's gains, each mode `copies` times at other pitches: copies err alike."""
    contacts = sample_contacts(PLATE, taps, generator=torch.Generator().manual_seed(0))
    modes = plate_modes(PLATE, contacts, highest=HIGHEST)
    values = torch.stack([modes.gains, torch.zeros_like(modes.gains)], dim=2).double().repeat(1, copies, 1)
    higher = torch.linspace(1.0, 1.5, copies, dtype=torch.float64).repeat_interleave(len(modes.frequency))
    bank = ModalBank(modes.frequency.repeat(copies) * higher, modes.damping.repeat(copies))
    points = plate_surface_points(PLATE, 600).float()
    gains = thin_plate_gains(contacts, values, importance=1 / bank.damping, points=points)
    zero = torch.zeros(len(bank), dtype=torch.float64)
    return SoundField(bank, gains, zero, Residual(torch.full((9,), 1e-3)), 8000.0, 4000, Origin("plate"))


def test_modes_that_err_alike_tell_no_more_than_one_of_them() -> None:
    # Ten times as many modes tell nothing new; what is thought beforehand keeps the factor from a whole tenth.
    assert heed_of(plate_splines(40, copies=10)) < 0.2 * heed_of(plate_splines(40))


def test_levels_and_edits_change_nothing() -> None:
    field = plate_splines(20)
    gains = field.gain_field
    louder = replace(field, gain_field=replace(gains, values=1000.0 * gains.values))
    assert heed_of(louder) == heed_of(field)
    edited = replace(field, gain_field=ScaledGains(gains, torch.full((len(field.bank),), 0.1).double(), 2.0))
    assert heed_of(edited) == heed_of(field)


def test_modes_that_an_edit_muted_have_no_say() -> None:
    whole = plate_splines(40, copies=10)
    scale = torch.zeros(len(whole.bank), dtype=torch.float64)
    scale[: len(scale) // 10] = 3.0
    muted = replace(whole, gain_field=ScaledGains(whole.gain_field, scale))
    assert heed_of(muted) == pytest.approx(heed_of(plate_splines(40)), rel=0.2)


def test_fields_with_too_few_strikes_are_heeded_as_fields_are_on_the_whole() -> None:
    few = plate_splines(20)
    gains = few.gain_field
    only = replace(gains, contacts=gains.contacts[:2], values=gains.values[:2])
    assert heed_of(replace(few, gain_field=only)) == 1.0
    same = replace(gains, contacts=gains.contacts[:1].expand(20, 3))
    assert heed_of(replace(few, gain_field=same)) == 1.0


def test_a_strike_beside_another_in_the_same_place_is_left_out_with_it() -> None:
    field = plate_splines(12)
    gains = field.gain_field
    twice = replace(gains, contacts=gains.contacts.repeat(2, 1), values=gains.values.repeat(2, 1, 1))
    assert heed_of(replace(field, gain_field=twice)) == pytest.approx(heed_of(field), rel=1e-9)


def test_regions_are_the_wider_the_less_modes_are_heeded() -> None:
    field = plate_splines(40)
    sound, sizes = field.render(field.gain_field.points[200:201])[0], []
    for heed in (1.0, 0.1, 0.01):
        locator = Locator.of(field)
        vars(locator)["_heed"] = heed
        sizes.append(int(locator.locate(sound).region().sum()))
    assert sizes[0] < sizes[1] < sizes[2]
