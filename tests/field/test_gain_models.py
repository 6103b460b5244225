"""What holds of every gain field, whatever it is made of: the contract of `GainModel`."""

import math
from copy import deepcopy
from functools import cache
from pathlib import Path

import pytest
import torch

from avmsf.errors import FieldFileError
from avmsf.evaluation.task import Renderer
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.estimator import RefinedGains
from avmsf.field.gains.kernels import Visual
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import GainModel, Gains
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.symmetry.characters import groups_of
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.made_fields import BANK, FIELDS, SIDES, SIZE, blows, draw, mixture, places, rewritten, sounding, struck
from factories.raising import raises

FACTORS = torch.tensor([2.0, -0.5, 1.5, 0.25, 3.0], dtype=torch.float64)
SCALED = {
    f"scaled {name}": cache(lambda name=name: ScaledGains(FIELDS[name](), FACTORS))
    for name in ("attention with dampings", "positional", "elastic", "body")
}
"""Of every kind that can be inside; other sizes have tests of their own, for these objects have the same."""


@cache
def symmetric_and_visual() -> MixtureGains:
    """Return a model of few gains that say nothing, so that no family is left out."""
    (sites, values), origin = struck(5), torch.zeros(3, dtype=torch.float64)
    x, y, z = torch.eye(3, dtype=torch.float64)
    planes, axis = tuple(MirrorSymmetry(each, origin, 0.0) for each in (x, y)), RotationalSymmetry(z, origin, None, 0.0)
    groups = groups_of(Symmetries((axis,), planes, 0.01, 0.38, math.inf))
    points, noise = places(150, seed=0).float(), torch.view_as_complex(draw(*values.shape, 2, seed=5))
    looks = Visual(sites, SIZE, points, draw(150, 2, seed=7).float())
    return mixture(sites, noise, Symmetric(sites, SIZE, groups, directional=True), looks, directional=True)


ALL = {**FIELDS, **SCALED, "symmetric and visual": symmetric_and_visual}
MODES = len(BANK)
PLACES = places(7, seed=8)
BLOWS = blows(PLACES, seed=9)
PHASE = torch.tensor([0.0, 0.4, -1.2, 3.0, 1.6], dtype=torch.float64)

every_field = pytest.mark.parametrize("name", ALL)
every_kind = pytest.mark.parametrize(
    "name", ["attention", "positional", "symmetric and visual", "elastic", "body", "scaled elastic", "scaled body"]
)
DIRECTIONAL = ("directional", "elastic", "scaled elastic", "body", "scaled body", "symmetric and visual")
"""Fields that know directions of impacts."""
REAL = ("attention", "attention with dampings", "scaled attention with dampings", "body", "scaled body")
"""Fields of real gains, without a standard deviation."""


def sound_field(gains: GainModel, *, noise: float = 0.0) -> SoundField:
    return sounding(gains, phase=PHASE, noise=noise, samples=600)


def parts(field: GainModel, contacts: torch.Tensor, directions: torch.Tensor | None = None) -> list[torch.Tensor]:
    """Return all that a field knows at contacts."""
    known = field.predict(contacts, directions)
    said = [known.mean, known.damping, field.posterior(contacts, directions).std]
    return [each for each in said if each is not None]


def expect_close(found: list[torch.Tensor], expected: list[torch.Tensor], *, within: float = 1e-5) -> None:
    """Compare to the rounding of float32 sums, which other orders of the same sums have."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=within, atol=within * float(other.abs().max()))


def test_power_is_the_same_whatever_the_phase():
    size, turn = torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([0.3, -1.1, 2.0])
    turned = Gains(torch.polar(size, turn.expand_as(size)))
    # The rounding of float32 amplitudes.
    torch.testing.assert_close(turned.power, size.double().square(), rtol=1e-6, atol=0)
    torch.testing.assert_close(Gains(-size).power, size.double().square())


@every_field
def test_gains_are_a_number_a_contact_and_mode(name):
    field = ALL[name]()
    assert isinstance(field, GainModel)
    assert (field.points.shape, field.points.dtype) == ((150, 3), torch.float32)
    assert bool((field.points.abs() <= torch.tensor(SIDES) / 2 + 1e-6).all())
    for count in (7, 1, 0):
        known = field.predict(PLACES[:count], BLOWS[:count])
        kind = torch.float32 if name in REAL else torch.complex64
        assert (known.mean.shape, known.mean.dtype) == ((count, MODES), kind)
        assert known.damping is None or (known.damping.shape, known.damping.dtype) == ((count, MODES), torch.float32)
        deviation = field.posterior(PLACES[:count], BLOWS[:count]).std
        assert deviation is None or (deviation.shape, deviation.dtype) == ((count, MODES, 2), torch.float32)
    assert all(bool(torch.isfinite(each).all()) for each in parts(field, PLACES, BLOWS))
    assert known.damping is None or float(field.predict(PLACES).damping.min()) > 0
    assert (deviation is None) == (name in REAL)
    assert deviation is None or float(field.posterior(PLACES).std.min()) > 0
    # They vary over the object, or nothing below would be seen.
    assert float(field.predict(PLACES).mean.std(0).max()) > 0


@every_field
@pytest.mark.parametrize("rows", [[0], [6, 2], [6, 5, 4, 3, 2, 1, 0], [3, 3, 3]])
def test_a_contacts_gains_do_not_depend_on_the_others(name, rows):
    field = ALL[name]()
    together = [each[rows] for each in parts(field, PLACES, BLOWS)]
    expect_close(parts(field, PLACES[rows], BLOWS[rows]), together)


@every_field
def test_contacts_in_float32_and_float64_are_the_same_places(name):
    field = ALL[name]()
    assert PLACES.dtype == torch.float64
    single, double = (parts(field, contacts) for contacts in (PLACES.float(), PLACES))
    assert all(torch.equal(*each) for each in zip(single, double, strict=True))


@every_field
def test_an_impact_from_the_other_side_has_opposite_gains_or_its_direction_is_not_used(name):
    field = ALL[name]()
    here, there = field.predict(PLACES, BLOWS), field.predict(PLACES, -BLOWS)
    sign = -1.0 if name in DIRECTIONAL else 1.0
    assert torch.equal(there.mean, sign * here.mean)
    deviations = [field.posterior(PLACES, directions).std for directions in (BLOWS, -BLOWS)]
    assert deviations == [None, None] or torch.equal(*deviations)


@every_field
def test_without_a_direction_an_impact_goes_straight_into_the_body_or_as_its_neighbor(name):
    field = ALL[name]()
    contacts = field.points[:7]
    assumed = torch.zeros_like(contacts)
    assumed[:, 2] = -contacts[:, 2].sign()
    if name in ("directional", "symmetric and visual"):
        near = torch.cdist(contacts.double(), field.training.points).argmin(1)
        assumed = field.training.directions[near]
    expect_close(parts(field, contacts), parts(field, contacts, assumed))
    expect_close(parts(field, contacts, torch.zeros(7, 3)), parts(field, contacts))
    expect_close(parts(field, contacts, 3.0 * BLOWS), parts(field, contacts, BLOWS))
    askew = field.predict(contacts, BLOWS).mean
    assert torch.equal(askew, field.predict(contacts).mean) == (name not in DIRECTIONAL)


@pytest.mark.parametrize("name", [name for name in FIELDS if name != "body"])
def test_modes_put_in_another_order_are_the_same_modes(name):
    order, field = torch.tensor([2, 4, 0, 3, 1]), FIELDS[name]()
    trainable = deepcopy(field) if isinstance(field, AttentionGains) else RefinedGains(field, BANK)
    moved = trainable.finished(order)
    expect_close(parts(moved, PLACES, BLOWS), [each[:, order] for each in parts(field, PLACES, BLOWS)])
    assert moved.record() == field.record()


@every_field
def test_a_field_comes_back_from_its_file_to_the_last_bit(name, tmp_path):
    field = ALL[name]()
    saved = sound_field(field, noise=0.01)
    save(saved, tmp_path / "one")
    loaded = load(tmp_path / "one")
    assert type(loaded.gain_field) is type(saved.gain_field)
    assert loaded.gain_field.record() == saved.gain_field.record()
    assert torch.equal(loaded.gain_field.points, saved.gain_field.points)
    for directions in (None, BLOWS):
        said = zip(*(parts(each.gain_field, PLACES, directions) for each in (loaded, saved)), strict=True)
        assert all(torch.equal(*each) for each in said)
        sounds = [each.render(PLACES, directions=directions) for each in (loaded, saved)]
        assert torch.equal(*sounds)
    assert name != "symmetric and visual" or {Symmetric.kind, Visual.kind} <= set(field.record()["families"])
    if isinstance(field, MixtureGains):
        assert torch.equal(loaded.gain_field.standardized_errors(), field.standardized_errors())
    save(loaded, tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


@every_field
def test_a_sound_is_the_sum_of_damped_sines_and_cosines(name):
    field = ALL[name]()
    known, times = field.point_estimate(PLACES, BLOWS), torch.arange(600, dtype=torch.float64) / 8000.0
    along, ahead = known.parts.unbind(2)
    factors = torch.ones_like(along) if known.damping is None else known.damping
    assert (float(ahead.abs().max()) > 0) == (name not in REAL)
    expected = torch.zeros(7, 600, dtype=torch.float64)
    for mode in range(MODES):
        angle = 2 * torch.pi * BANK.frequency[mode] * times + PHASE[mode]
        decay = torch.exp(-BANK.damping[mode] * factors[:, mode, None].double() * times)
        waves = along[:, mode, None] * torch.sin(angle) + ahead[:, mode, None] * torch.cos(angle)
        expected += decay * waves
    renderer = sound_field(field)
    assert isinstance(renderer, Renderer)
    sounds = renderer.render(PLACES, directions=BLOWS)
    # Float32 sums: a millionth of the loudest sample.
    torch.testing.assert_close(sounds.double(), expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert torch.equal(renderer.gains(PLACES, directions=BLOWS), known.mean.real)
    poles = -BANK.damping * factors.double() + 2j * torch.pi * BANK.frequency
    amplitudes = renderer.complex_gains(PLACES, directions=BLOWS)
    phasors = (amplitudes[..., None] * torch.exp(poles[..., None] * times)).sum(1)
    torch.testing.assert_close(phasors.real, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))
    assert torch.equal(renderer.render(PLACES), sounds) == (name not in DIRECTIONAL)


def changed(name: str, folder: Path, tensors: dict[str, torch.Tensor], record: dict) -> Path:
    """Save a field of this kind, with some of its tensors and of what it says of itself replaced; None takes it out."""
    if not (folder / "whole").exists():
        save(sound_field(ALL[name]()), folder / "whole")

    def change(held: dict[str, torch.Tensor], header: dict) -> None:
        for old, new in ((held, {f"gains.{key}": each for key, each in tensors.items()}), (header, record)):
            old |= new
            for key in [key for key, value in new.items() if value is None]:
                del old[key]

    return rewritten(folder / "whole", change)


@every_kind
def test_a_record_is_refused_where_anything_is_missing_or_wrong(name, tmp_path):
    field = ALL[name]()
    whole = {"kind": field.kind, **field.record()}
    load(changed(name, tmp_path, {}, {"gains": whole}))
    for key, value in whole.items():
        # No number of things is a fraction.
        wrong = {
            dict: [None, {}],
            str: [None, 8],
            bool: [None, 1],
            int: [None, True, -1, value + 0.5 if isinstance(value, int) else None],
            float: [None, "eight", -1.0],
            list: [None, 8, "eight", [*value, 8] if isinstance(value, list) else None],
        }
        for other in wrong[type(value)]:
            with raises(FieldFileError, file="changed.safetensors"):
                load(changed(name, tmp_path, {}, {"gains": whole | {key: other}}))
        if key == "spread_share":
            # Files of earlier versions have none.
            continue
        missing = {each: whole[each] for each in whole if each != key}
        with raises(FieldFileError, file="changed.safetensors", name=key):
            load(changed(name, tmp_path, {}, {"gains": missing}))


@every_kind
def test_sizes_that_are_not_the_tensors_are_refused(name, tmp_path):
    field = ALL[name]()
    whole = {"kind": field.kind, **field.record()}
    wrong = [{key: whole[key] + 1} for key in ("points", "contacts", "dim", "nodes", "triangles") if key in whole]
    if "kernels" in whole:
        wrong.append({"kernels": [1 + each for each in whole["kernels"]]})
    for body in whole.get("bodies", []):
        wrong += [{"bodies": [body | {key: size + 1}]} for key, size in body.items()]
    for each in wrong:
        with raises(FieldFileError, file="changed.safetensors") as caught:
            load(changed(name, tmp_path, {}, {"gains": whole | each}))
        assert caught.value.name.startswith("gains.")
    with raises(FieldFileError, name="gains.modes", value=MODES + 1):
        load(changed(name, tmp_path, {}, {"gains": whole | {"modes": MODES + 1}}))


@every_kind
def test_damaged_tensors_are_refused_by_name(name, tmp_path):
    for key, tensor in ALL[name]().tensors().items():
        with raises(FieldFileError, name=f"gains.{key}", value=None):
            load(changed(name, tmp_path, {key: None}, {}))
        # Not finite, or no whole numbers.
        with raises(FieldFileError, name=f"gains.{key}"):
            load(changed(name, tmp_path, {key: tensor * torch.nan}, {}))
        with raises(FieldFileError, name=f"gains.{key}", value=f"float16{list(tensor.shape)}"):
            load(changed(name, tmp_path, {key: tensor.half()}, {}))
    with raises(FieldFileError, name="gains.more", value=["gains.more"]):
        load(changed(name, tmp_path, {"more": torch.ones(3)}, {}))
