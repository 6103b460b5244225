"""Another material, another size: the laws against plates in closed form and against fresh finite-element solves."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.editing.material import LAWS, MAX_MISMATCH, change_material, edit, guess_materials, infer_material
from avmsf.editing.modal_edit import ModalEdit, adjust_modes, silenced
from avmsf.errors import EditError, SimulationError
from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.material import CERAMIC, GLASS, NOMINAL, PLASTIC, STEEL, WOOD, Material
from avmsf.fem.vibration import rayleigh
from avmsf.field.gains.kernels import Smooth
from avmsf.field.sound_field import SUPPORTING, Origin, SoundField
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.located_plate import mixture_of
from factories.raising import raises
from oracles.block import block
from oracles.plate import Plate, plate_modes, sample_contacts

CONTACTS = sample_contacts(Plate(), 8, generator=torch.Generator().manual_seed(0))
OTHER = Material("other", 1900.0, 9.1e10, 0.29, 3.0, 8e-8)
THIRD = Material("third", 4300.0, 5e9, 0.1, 0.0, 2e-6)
SMALL_FLOAT = 1e-6
"""Gains are float32 numbers."""


def plate_of(material: Material, *, size: float = 1.0) -> Plate:
    sizes = {name: size * getattr(Plate(), name) for name in ("length", "width", "thickness")}
    return Plate(**sizes, **{name: value for name, value in vars(material).items() if name != "name"})


def field_of(frequency: torch.Tensor, damping: torch.Tensor, gains: torch.Tensor, contacts: torch.Tensor) -> SoundField:
    """Return a field that has these gains at these contacts, and smooth ones between them."""
    values = torch.complex(gains, 0.5 * gains.roll(1, dims=1))
    size, bank = float((contacts.amax(0) - contacts.amin(0)).norm()), ModalBank(frequency, damping)
    model = mixture_of(contacts, values, bank=bank, points=contacts, positional=[Smooth], size=size)
    # The mean at the contacts is linear in the gains measured there: these have it pass through the given ones.
    series = torch.cat([values.real, values.imag], dim=1).double()
    passed = torch.linalg.solve(model.mixture.smoother(), series.T[..., None])[..., 0].T
    model = model.with_values(torch.complex(*passed.contiguous().chunk(2, dim=1)))
    phase, noise = torch.zeros_like(frequency), Residual(torch.full((9,), 1e-9))
    return SoundField(bank, model, phase, noise, 44100.0, 2000, Origin("plate"))


RATIO = {each: each.young / each.density for each in (STEEL, NOMINAL)}


def plate_field(material: Material, *, size: float = 1.0, highest: float = 3000.0) -> SoundField:
    modes = plate_modes(plate_of(material, size=size), size * CONTACTS, highest=highest)
    return field_of(modes.frequency, modes.damping, modes.gains, size * CONTACTS)


def gains_of(field: SoundField, contacts: torch.Tensor) -> torch.Tensor:
    return field.gain_field.predict(contacts).parts.permute(2, 0, 1)


def expect_same(found: SoundField, expected: SoundField, contacts: torch.Tensor) -> None:
    # Rounding of float64: some ten operations.
    for name in ("frequency", "damping"):
        torch.testing.assert_close(getattr(found.bank, name), getattr(expected.bank, name), rtol=1e-13, atol=0)
    one, other = gains_of(found, contacts), gains_of(expected, contacts)
    torch.testing.assert_close(one, other, rtol=0, atol=SMALL_FLOAT * float(other.abs().max()))
    assert torch.equal(found.gain_field.points, expected.gain_field.points)


@pytest.mark.parametrize("size", [1.0, 0.5, 3.0])
def test_a_plate_of_another_material_and_size_is_the_one_in_closed_form(size):
    steel = replace(STEEL, beta=4e-7)
    faster = math.sqrt(OTHER.young / OTHER.density / (steel.young / steel.density)) / size
    undamped = 3000.0
    expected = plate_modes(plate_of(OTHER, size=size), size * CONTACTS, highest=undamped * faster)
    # A plate's gains are pseudo-velocities, see `oracles.plate`.
    found = change_material(plate_field(steel, highest=undamped), steel, OTHER, size=size, law="velocity")
    torch.testing.assert_close(found.bank.frequency, expected.frequency, rtol=1e-13, atol=0)
    torch.testing.assert_close(found.bank.damping, expected.damping, rtol=1e-13, atol=0)
    gains = gains_of(found, size * CONTACTS)[0]
    torch.testing.assert_close(gains, expected.gains, rtol=0, atol=SMALL_FLOAT * float(expected.gains.abs().max()))
    # Displacements are those over the damped angular frequency, accelerations are times it.
    for law, power in (("displacement", 1.0), ("acceleration", -1.0)):
        other = change_material(plate_field(steel, highest=undamped), steel, OTHER, size=size, law=law)
        start = plate_modes(plate_of(steel), CONTACTS, highest=undamped).frequency
        ratio = gains_of(other, size * CONTACTS)[0] / gains
        torch.testing.assert_close(ratio, ((start / expected.frequency) ** power).expand_as(ratio), rtol=1e-5, atol=0)


def test_the_law_of_the_paper_divides_gains_by_the_change_of_the_frequency():
    field = plate_field(CERAMIC)
    found = change_material(field, CERAMIC, WOOD, size=2.0, law="ratio-only")
    change = gains_of(found, 2.0 * CONTACTS) / gains_of(field, CONTACTS)
    expected = field.bank.frequency / found.bank.frequency
    torch.testing.assert_close(change, expected.expand_as(change), rtol=1e-6, atol=0)


@pytest.mark.parametrize("size", [1.0, 0.6])
def test_changing_the_material_is_a_fresh_finite_element_solve(size):
    new = replace(OTHER, poisson=CERAMIC.poisson)
    generator = torch.Generator().manual_seed(1)
    places = torch.rand(6, 3, dtype=torch.float64, generator=generator) * torch.tensor([0.11, 0.07, 0.0])
    ways = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64, generator=generator), dim=1)

    def solved(material: Material, scale: float) -> SoundField:
        body = elastic_modes(block((0.11 * scale, 0.07 * scale, 0.02 * scale), (4, 3, 1)), material, count=10)
        damping = rayleigh(body.frequency, material) / 2
        angular = torch.sqrt((2 * math.pi * body.frequency) ** 2 - damping**2)
        shapes = body.gains(scale * places, ways)
        # Displacement of the last place, by a newton second at each.
        return field_of(angular / (2 * math.pi), damping, shapes * shapes[-1] / angular, scale * places)

    found, fresh = change_material(solved(CERAMIC, 1.0), CERAMIC, new, size=size), solved(new, size)
    frequency = (found.bank.frequency / fresh.bank.frequency - 1).abs()
    assert float(frequency.max()) < 1e-9
    assert float((found.bank.damping / fresh.bank.damping - 1).abs().max()) < 1e-8
    one, other = gains_of(found, size * places)[0], gains_of(fresh, size * places)[0]
    # Of each mode by itself, for high ones move less: shapes of a second solve agree to some 1e-6.
    assert float(((one - other).abs().amax(0) / other.abs().amax(0)).max()) < SMALL_FLOAT


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_a_material_given_to_itself_and_one_by_way_of_another(law):
    field = plate_field(STEEL)
    # Dampings that are not those of the material: a mode's own part of them stays with it.
    field = replace(
        field, bank=ModalBank(field.bank.frequency, field.bank.damping * torch.linspace(0.5, 3.0, len(field.bank)))
    )
    expect_same(change_material(field, STEEL, STEEL, law=law), field, CONTACTS)
    twice = change_material(change_material(field, STEEL, OTHER, size=0.5, law=law), OTHER, THIRD, size=3.0, law=law)
    expect_same(twice, change_material(field, STEEL, THIRD, size=1.5, law=law.name), 1.5 * CONTACTS)
    expect_same(change_material(twice, THIRD, STEEL, size=1 / 1.5, law=law), field, CONTACTS)
    assert len(twice.origin.report["edits"]) == 2


def test_modes_without_a_tone_are_mute_and_named_and_stay_where_they_are():
    field = plate_field(GLASS)
    lossy = replace(GLASS, name="felt", alpha=12000.0)
    omega = torch.hypot(2 * math.pi * field.bank.frequency, field.bank.damping)
    dead = 0.5 * (12000.0 + GLASS.beta * omega**2) >= omega
    assert 1 < int(dead.sum()) < len(dead)
    field = replace(field, origin=Origin("plate", report={SUPPORTING: [int(dead.nonzero()[0])]}))
    found = change_material(field, GLASS, lossy)
    assert torch.equal(gains_of(found, CONTACTS).abs().amax((0, 1)) == 0, dead)
    told = found.origin.report["edits"][-1]
    # Supporting poles are muted too, but are no modes.
    assert told["overdamped_hertz"] == field.bank.frequency[dead & field.is_mode].tolist()
    assert f"{int(dead.sum()) - 1} of {len(dead) - 1} modes overdamped" in told["remarks"][0]
    assert bool(torch.isfinite(found.render(CONTACTS)).all())
    back = change_material(found, lossy, GLASS)
    for name in ("frequency", "damping"):
        before = getattr(field.bank, name)
        assert torch.equal(getattr(found.bank, name)[dead], before[dead])
        torch.testing.assert_close(getattr(back.bank, name), before, rtol=1e-13, atol=0)
    before, after = gains_of(field, CONTACTS), gains_of(back, CONTACTS)
    torch.testing.assert_close(after, torch.where(dead, 0.0, before), rtol=1e-6, atol=0)
    assert back.origin.report["edits"][-1]["remarks"] == []


def test_a_mute_mode_is_none_that_a_lower_pitch_brings_back():
    found = change_material(plate_field(GLASS), GLASS, replace(GLASS, alpha=4e5))
    high = adjust_modes(found, pitch=1e3)
    assert not bool(high.audible.any())
    assert high.origin.report["edits"][-1]["silent_hertz"] == []
    assert not bool(silenced(high).any())
    assert change_material(high, GLASS, replace(GLASS, alpha=4e9)).origin.report["edits"][-1]["overdamped_hertz"] == []


def test_another_poissons_ratio_is_said_with_what_it_would_do_to_a_plate():
    stiff = replace(STEEL, poisson=0.45)
    (words,) = change_material(plate_field(STEEL), STEEL, stiff).origin.report["edits"][-1]["remarks"]
    lowest = [float(plate_modes(plate_of(each), CONTACTS).frequency[0]) for each in (STEEL, stiff)]
    assert f"about {100 * (lowest[1] / lowest[0] - 1):+.1f} %" in words
    same = change_material(plate_field(STEEL), STEEL, replace(STEEL, young=1e11))
    assert same.origin.report["edits"][-1]["remarks"] == []


BARE = replace(OTHER, name="aether", alpha=0.0, beta=0.0)


@pytest.mark.parametrize(
    ("old", "new", "size", "attributes"),
    [
        *((STEEL, OTHER, size, {"name": "size", "value": size}) for size in (0.0, -1.0, math.inf)),
        (STEEL, BARE, 1.0, {"name": "new", "value": (0.0, 0.0)}),
        (BARE, STEEL, 1.0, {"name": "old", "value": (0.0, 0.0)}),
        (STEEL, OTHER, 1e-170, {"name": "damping", "row": 0, "value": math.inf}),
    ],
)
def test_materials_and_sizes_that_cannot_be_are_refused(old, new, size, attributes):
    with raises(EditError, **attributes):
        change_material(plate_field(STEEL), old, new, size=size)
    with raises(EditError, name="law", value="accelerations"):
        edit(plate_field(STEEL), size=2.0, old_material=STEEL, law="accelerations")
    with raises(SimulationError, name="young", value=-1.0):
        Material("lead", 1e4, -1.0, 0.4, 1.0, 0.0)
    # Where neither material damps, dampings stay.
    bare = change_material(plate_field(STEEL), replace(STEEL, alpha=0.0, beta=0.0), BARE)
    assert torch.equal(bare.bank.damping, plate_field(STEEL).bank.damping)


@pytest.mark.parametrize("material", [GLASS, WOOD, PLASTIC, STEEL], ids=lambda each: each.name)
def test_the_material_is_guessed_by_its_dampings(material):
    field = plate_field(material)
    generator = torch.Generator().manual_seed(0)
    off = torch.exp(0.1 * torch.randn(len(field.bank), dtype=torch.float64, generator=generator))
    off[3] = 40.0
    (best, ratio), (_, second), *_ = guess_materials(ModalBank(field.bank.frequency, field.bank.damping * off))
    assert best is material
    # A normal deviation of .1 has its middle at .067; one mode that is quite off counts for little.
    assert 1.02 < ratio < 1.12
    assert second > ratio
    assert guess_materials(ModalBank(field.bank.frequency, 30 * field.bank.frequency))[0][1] > MAX_MISMATCH


def test_supporting_poles_say_nothing_about_the_material():
    field = plate_field(STEEL)
    damping = field.bank.damping.clone()
    supporting = list(range(1, len(damping)))
    damping[supporting] *= 30.0
    report = {SUPPORTING: supporting}
    mixed = replace(field, bank=ModalBank(field.bank.frequency, damping), origin=Origin("plate", report=report))
    assert infer_material(mixed, option="--from")[0] == STEEL


def test_a_body_too_stiff_for_a_material_excludes_it():
    """Wood's dampings on a body that is as stiff for its weight as steel are nobody's."""
    body = {"body": "solid body", "wall_thickness": None, "frequency_factor": math.sqrt(RATIO[STEEL] / RATIO[NOMINAL])}
    origin = Origin("plate", report={"credibility": {"credible": True}, "bodies": [body]})
    steel = replace(plate_field(STEEL), origin=origin)
    assert infer_material(steel, option="--from")[0] == STEEL
    with raises(EditError, name="--from"):
        infer_material(replace(plate_field(WOOD), origin=origin), option="--from")


def test_a_body_excludes_no_material_that_a_guided_edit_has_led_to():
    body = {"body": "solid body", "wall_thickness": None, "frequency_factor": math.sqrt(RATIO[STEEL] / RATIO[NOMINAL])}
    origin = Origin("plate", report={"credibility": {"credible": True}, "bodies": [body]})
    wooden = ModalEdit.none(plate_field(WOOD).bank).of(replace(plate_field(WOOD), origin=origin))
    assert infer_material(wooden, option="--from")[0] == WOOD
