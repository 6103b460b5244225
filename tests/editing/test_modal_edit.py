"""Sliders and edits: pitch, decay, brightness and levels, alone, together and undone, the same all over the object."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.editing.material import change_material, guess_materials, infer_material, rayleigh_damping
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit, adjust_modes, brightness_center
from avmsf.errors import EditError
from avmsf.fem.material import CERAMIC, WOOD
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.modes import ModalBank
from factories.made_fields import BANK, FIELDS, places, sounding
from factories.raising import raises

PLACES = places(7, seed=8)


def plate_field(name: str = "positional") -> SoundField:
    phase, origin = torch.tensor([0.0, 0.4, -1.2, 3.0, 1.6]), Origin("plate", report={"gains": "made"})
    return sounding(FIELDS[name](), phase=phase, noise=1e-9, samples=600, origin=origin)


def change_db(before: SoundField, after: SoundField) -> torch.Tensor:
    """Return by how many decibels each mode became louder, the same at all places."""
    ratio = (after.gains(PLACES) / before.gains(PLACES)).double()
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-6, atol=0)
    return 20 * torch.log10(ratio[0])


def expect_same(found: SoundField, expected: SoundField) -> None:
    for name in ("frequency", "damping"):
        torch.testing.assert_close(getattr(found.bank, name), getattr(expected.bank, name), rtol=1e-14, atol=0)
    torch.testing.assert_close(found.gains(PLACES), expected.gains(PLACES), rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", ["positional", "attention with dampings", "elastic"])
def test_pitch_moves_frequencies_and_decay_the_ring_times(name):
    before, factors = plate_field(name), torch.linspace(0.5, 1.5, 5, dtype=torch.float64)
    after = adjust_modes(before, pitch=1.2, decay=factors)
    torch.testing.assert_close(after.bank.frequency, 1.2 * before.bank.frequency)
    torch.testing.assert_close(1 / after.bank.damping, factors / before.bank.damping)
    then, now = (each.known(PLACES).dampings(each.bank.damping).double() for each in (before, after))
    torch.testing.assert_close(now, then / factors, rtol=1e-6, atol=0)
    assert torch.equal(after.gains(PLACES), before.gains(PLACES))
    entry = after.origin.report["edits"][-1]
    assert (entry["edit"], entry["pitch"], entry["decay"]) == ("adjust_modes", 1.2, factors.tolist())
    assert torch.equal(adjust_modes(before).render(PLACES), before.render(PLACES))


def test_brightness_is_decibels_an_octave_about_the_center():
    before = plate_field()
    center = brightness_center(before)
    # Gains over the whole object, by hand.
    known = before.known(before.gain_field.points)
    power = known.mean.to(torch.complex128).abs().square().mean(0)
    by_hand = float((power * BANK.frequency.log()).sum() / power.sum())
    assert math.log(center) == pytest.approx(by_hand, rel=1e-6)
    louder = change_db(before, adjust_modes(before, brightness_db=6.0))
    torch.testing.assert_close(louder, 6.0 * torch.log2(BANK.frequency / center), rtol=0, atol=1e-5)
    # Heard where the modes come to lie.
    high = adjust_modes(before, brightness_db=6.0, pitch=[1.0, 1.0, 1.0, 1.0, 2.0])
    step = change_db(before, high) - 6.0 * torch.log2(high.bank.frequency / brightness_center(before, high.bank))
    assert float(step.abs().max()) < 1e-5


def test_levels_raise_and_mute_single_modes(tmp_path):
    before = plate_field()
    after = adjust_modes(before, gains_db=[0.0, 6.0, -math.inf, -6.0, 0.0])
    assert not bool(after.gains(PLACES)[:, 2].any())
    louder = change_db(before, after)
    assert louder[[0, 1, 3, 4]].tolist() == pytest.approx([0.0, 6.0, -6.0, 0.0], abs=1e-5)
    assert after.origin.report["edits"][-1]["gains_db"] == [0.0, 6.0, None, -6.0, 0.0]
    save(after, tmp_path / "one")
    assert torch.equal(load(tmp_path / "one").render(PLACES), after.render(PLACES))


def test_two_edits_are_the_one_with_both_and_an_edit_can_be_undone():
    before, factors = plate_field(), torch.linspace(0.5, 1.5, 5, dtype=torch.float64)
    one = {"pitch": 1.2, "decay": factors, "brightness_db": 4.0, "gains_db": 3 * factors}
    other = {"pitch": 0.7, "decay": 2.0, "brightness_db": -7.0, "gains_db": -4 * factors}
    both = {"pitch": 1.2 * 0.7, "decay": 2 * factors, "brightness_db": -3.0, "gains_db": -factors}
    expect_same(adjust_modes(adjust_modes(before, **one), **other), adjust_modes(before, **both))
    back = {"pitch": 1 / 1.2, "decay": 1 / factors, "brightness_db": -4.0, "gains_db": -3 * factors}
    expect_same(adjust_modes(adjust_modes(before, **one), **back), before)


def test_modes_beyond_half_the_sample_rate_are_silent_and_come_back():
    before = plate_field()
    high = adjust_modes(before, pitch=2.0)
    assert high.origin.report["edits"][-1]["silent_hertz"] == [4600.0]
    muted = adjust_modes(high, gains_db=[0.0, 0.0, 0.0, 0.0, -math.inf])
    assert torch.equal(high.render(PLACES), muted.render(PLACES))
    assert float((high.render(PLACES) - before.render(PLACES)).abs().max()) > 0
    expect_same(adjust_modes(high, pitch=0.5), before)
    gone = adjust_modes(before, pitch=100.0)
    assert len(gone.origin.report["edits"][-1]["silent_hertz"]) == 5
    # Nothing but the residual.
    assert float(gone.render(PLACES).abs().max()) < 1e-8


@pytest.mark.parametrize(
    ("name", "row", "value", "given"),
    [
        *(("pitch", 0, each, each) for each in (0.0, -1.0, math.inf)),
        *(("decay", 0, each, each) for each in (0.0, -1.0, math.inf)),
        ("pitch", 4, math.inf, [1.0, 1.1, 1.2, 1.3, math.inf]),
        ("decay", 2, 0.0, [1.0, 1.0, 0.0, 1.0, 1.0]),
        ("pitch", None, [3], [1.0, 1.0, 1.0]),
        ("gains_db", 0, math.inf, math.inf),
        ("brightness_db", None, math.inf, math.inf),
    ],
)
def test_values_that_cannot_be_are_refused(name, row, value, given):
    with raises(EditError, name=name, row=row, value=value):
        adjust_modes(plate_field(), **{name: given})
    for name in ("pitch", "decay", "gains_db", "brightness_db"):
        with raises(EditError, name=name):
            adjust_modes(plate_field(), **{name: math.nan})
    with raises(EditError, name="gain factor", row=0, value=math.inf):
        adjust_modes(plate_field(), gains_db=1e5)


def test_adjusted_modes_keep_the_material():
    """An octave lower, ceramic's dampings would be those of another material."""
    frequency = torch.tensor([1600.0, 2500.0, 4100.0, 6000.0, 9000.0], dtype=torch.float64)
    damping = rayleigh_damping(2.0 * math.pi * frequency, CERAMIC)
    ceramic = replace(plate_field(), bank=ModalBank(frequency, damping), sample_rate=48000.0)
    assert infer_material(ceramic, option="--from")[0] == CERAMIC
    lower = adjust_modes(adjust_modes(ceramic, pitch=0.25), decay=torch.linspace(0.1, 0.5, 5), brightness_db=3.0)
    assert guess_materials(lower.bank)[0][0] != CERAMIC
    assert infer_material(lower, option="--from")[0] == CERAMIC
    wooden = change_material(lower, CERAMIC, WOOD)
    assert infer_material(adjust_modes(wooden, pitch=2.0), option="--from")[0] == WOOD


def made_edit(*, pitch: float = math.log(0.7)) -> ModalEdit:
    first, second, third = [0.02, -0.01, 0.0, 0.03, 0.0], [0.0, 0.1, -0.1, 0.0, 0.2], [0.0, 0.5, -0.5, 0.1, 1.0]
    values = (pitch, first, math.log(3.0), second, third)
    return ModalEdit(*(torch.tensor(each, dtype=torch.float64) for each in values))


def test_the_formula_of_the_paper():
    field, edit = plate_field("elastic"), made_edit()
    bank = edit.of(field).bank
    torch.testing.assert_close(bank.frequency, 0.7 * field.bank.frequency * edit.shift.exp(), rtol=1e-13, atol=0)
    torch.testing.assert_close(bank.damping, 3.0 * field.bank.damping * edit.damping_shift.exp(), rtol=1e-13, atol=0)
    assert (edit.pitch_factor, edit.decay_factor) == (pytest.approx(0.7), pytest.approx(1 / 3))
    # Gains that follow frequencies keep their product with them.
    new = replace(edit, scale=torch.zeros(5, dtype=torch.float64)).following(field.bank).of(field)
    contacts = places(3, seed=4)
    before, after = (each.bank.frequency.float() * each.known(contacts).mean for each in (field, new))
    torch.testing.assert_close(after, before, rtol=1e-6, atol=0)


@pytest.mark.parametrize("pitch", [math.log(0.7), math.log(2.5)])
def test_what_is_optimized_is_what_the_edited_field_renders(pitch):
    # At 2.5 times the pitch two modes lie above half the rate, and are silent in both.
    field, edit = plate_field("elastic"), made_edit(pitch=pitch)
    contacts = places(4, seed=6)
    sounds = FieldAtContacts(field, field.known(contacts), field.samples).sounds(edit)
    rendered = edit.of(field).render(contacts)
    torch.testing.assert_close(sounds, rendered, rtol=0, atol=2e-6 * float(rendered.abs().max()))


def test_an_edited_field_saves_loads_and_is_edited_again(tmp_path):
    once = made_edit().of(plate_field("elastic"), settings={"prompt": "wood"})
    save(once, tmp_path / "edited.safetensors")
    again = made_edit().of(load(tmp_path / "edited.safetensors"))
    direct = made_edit().of(once)
    contacts = places(3, seed=8)
    assert torch.equal(again.render(contacts), direct.render(contacts))
    entries = again.origin.report["edits"]
    assert [each.get("prompt") for each in entries] == ["wood", None]
    assert [each["edit"] for each in entries] == ["guided", "guided"]
    assert entries[0]["pitch"] == pytest.approx(0.7)
    # As in an edit by hand: what rings a third as long.
    assert entries[0]["decay"] == pytest.approx(1 / 3)
    assert again.origin.report["gains"] == "made"


def test_edits_that_cannot_be_are_refused():
    edit = ModalEdit(*(torch.zeros(size, dtype=torch.float64) for size in ((), (3,), (), (3,), (3,))))
    with raises(EditError, name="shift", value=3):
        edit.of(plate_field("elastic"))
    with raises(EditError, name="frequency", row=0, value=math.inf):
        ModalEdit.none(plate_field("elastic").bank, pitch=800.0).of(plate_field("elastic"))
