"""An edit moves modes by what it says, and leaves where on the object they are loud alone."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.errors import EditError
from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import load, save
from avmsf.modal.residual_noise import Residual
from factories import made_fields
from factories.raising import raises

RATE = 8000.0


def made_field(kind: str = "elastic") -> SoundField:
    bank = made_fields.BANK
    phase = torch.linspace(-1.0, 1.0, len(bank), dtype=torch.float64)
    return SoundField(
        bank, made_fields.FIELDS[kind](), phase, Residual(torch.zeros(17)), RATE, 4000, Origin(report={"gains": "made"})
    )


def made_edit(*, pitch: float = math.log(0.7)) -> ModalEdit:
    return ModalEdit(
        torch.tensor(pitch, dtype=torch.float64),
        torch.tensor([0.02, -0.01, 0.0, 0.03, 0.0], dtype=torch.float64),
        torch.tensor(math.log(3.0), dtype=torch.float64),
        torch.tensor([0.0, 0.1, -0.1, 0.0, 0.2], dtype=torch.float64),
        torch.tensor([0.0, 0.5, -0.5, 0.1, 1.0], dtype=torch.float64),
    )


def test_the_formula_of_the_paper():
    field, edit = made_field(), made_edit()
    bank = edit.of(field).bank
    torch.testing.assert_close(bank.frequency, 0.7 * field.bank.frequency * edit.shift.exp(), rtol=1e-13, atol=0)
    torch.testing.assert_close(bank.damping, 3.0 * field.bank.damping * edit.damping_shift.exp(), rtol=1e-13, atol=0)
    assert (edit.pitch_factor, edit.decay_factor) == (pytest.approx(0.7), pytest.approx(1 / 3))
    # Gains that follow frequencies keep their product with them.
    new = replace(edit, scale=torch.zeros(5, dtype=torch.float64)).following(field.bank).of(field)
    contacts = made_fields.places(3, seed=4)
    before, after = (each.bank.frequency.float() * each.known(contacts).mean for each in (field, new))
    torch.testing.assert_close(after, before, rtol=1e-6, atol=0)


@pytest.mark.parametrize("kind", made_fields.FIELDS)
def test_gain_ratios_between_contacts_stay(kind):
    field, edit = made_field(kind), made_edit()
    before, after = (each.known(made_fields.places(7, seed=5)) for each in (field, edit.of(field)))
    # To the last digits of float32.
    torch.testing.assert_close(after.mean, before.mean * edit.scale.exp().float(), rtol=1e-6, atol=0)


@pytest.mark.parametrize("pitch", [math.log(0.7), math.log(2.5)])
def test_what_is_optimized_is_what_the_edited_field_renders(pitch):
    # At 2.5 times the pitch two modes lie above half the rate, and are silent in both.
    field, edit = made_field(), made_edit(pitch=pitch)
    contacts = made_fields.places(4, seed=6)
    sounds = FieldAtContacts.at(field, contacts, samples=field.samples).sounds(edit)
    rendered = edit.of(field).render(contacts)
    torch.testing.assert_close(sounds, rendered, rtol=0, atol=2e-6 * float(rendered.abs().max()))


def test_an_edited_field_saves_loads_and_is_edited_again(tmp_path):
    once = made_edit().of(made_field(), settings={"prompt": "wood"})
    save(once, tmp_path / "edited.safetensors")
    again = made_edit().of(load(tmp_path / "edited.safetensors"))
    direct = made_edit().of(once)
    contacts = made_fields.places(3, seed=8)
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
        edit.of(made_field())
    with raises(EditError, name="frequency", row=0, value=math.inf):
        ModalEdit.none(made_field().bank, pitch=800.0).of(made_field())
