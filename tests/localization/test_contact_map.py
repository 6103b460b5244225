"""The posterior over contacts, and how far a field's modes are independent evidence."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.errors import ArrayError, LocationError
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.localization.prediction import calibrate_tempering
from avmsf.modal.modes import ModalBank
from factories.located_plate import PLATE, TrueGains, field_of, mixture_of, struck
from factories.made_fields import sounding
from factories.raising import raises
from oracles.plate import plate_modes, plate_surface_points, sample_contacts


def made(probability: list[float]) -> ContactPosterior:
    """Return a map of points in a row, a centimeter apart."""
    points = torch.zeros(len(probability), 3)
    points[:, 0] = 0.01 * torch.arange(len(probability))
    chances = torch.tensor(probability, dtype=torch.float64)
    return ContactPosterior(points, 1 - chances, chances, 0.9, 0.9, 0.1)


def test_region_is_the_smallest_set_of_that_probability():
    found = made([0.05, 0.5, 0.3, 0.05, 0.1])
    assert found.region(0.9).tolist() == [False, True, True, False, True]
    assert found.region(0.5).tolist() == [False, True, False, False, False]
    assert found.region(0.97).sum() == 5
    assert [found.contains([0.01 * row + 0.004, 0.02, 0.0]) for row in range(5)] == found.region().tolist()
    assert found.credible_radius(0.95) == pytest.approx(0.03, rel=1e-5)
    assert found.credible_radius(0.85) == pytest.approx(0.01, rel=1e-5)
    # .35 a centimeter away, .05 two and .1 three.
    assert found.position_std == pytest.approx(0.01 * math.sqrt(0.35 + 0.05 * 4 + 0.1 * 9), rel=1e-5)
    for call in (found.region, found.credible_radius):
        with raises(LocationError, name="level", value=1.5):
            call(1.5)
    with raises(ArrayError, name="contact", value=[1, 2]):
        found.contains([0.01, 0.0])


def test_peaks_are_positions_apart_that_hold_some_probability():
    chances = [0.0] * 30
    chances[3], chances[4], chances[5] = 0.2, 0.2, 0.1
    chances[20], chances[21] = 0.25, 0.2
    chances[28] = 0.05
    found = made(chances)
    first, second = found.peaks(0.94)
    assert (first.row, second.row) == (3, 20)
    assert first.probability == pytest.approx(0.5)
    assert second.probability == pytest.approx(0.45)
    assert second.points.nonzero().flatten().tolist() == [20, 21]
    assert found.multimodal
    assert len(found.peaks(0.99, least=0.04)) == 3
    assert len(found.peaks(0.99, least=0.06)) == 2
    assert not made([0.1, 0.8, 0.1]).multimodal


def test_other_positions_include_a_broader_peak_and_not_the_answer():
    chances = [0.0] * 30
    chances[20] = 0.15
    chances[0:8] = [0.07] * 8
    chances[26] = 0.29
    found = made(chances)
    broad, narrow = found.equivalent_points(level=0.999)
    assert found.position.tolist() == pytest.approx([0.26, 0.0, 0.0])
    assert (broad.probability, narrow.probability) == (pytest.approx(0.56), pytest.approx(0.15))
    told = found.describe(level=0.999)
    assert told["position_probability"] == pytest.approx(0.29)
    positions = [each["position"][0] for each in told["equivalent_points"]]
    assert positions == [pytest.approx(0.0, abs=0.08), pytest.approx(0.2)]


def test_a_symmetric_plate_is_ambiguous() -> None:
    # Heard from its middle, where all modes that are odd about it are silent.
    plate = replace(PLATE, pickup=(0.5, 0.5))
    field = field_of(TrueGains(plate_surface_points(PLATE, 1600).float(), plate=plate))
    found = Locator.of(field).locate(struck(1, seed=14, noise_db=-20.0, plate=plate).sounds[0])
    others = found.equivalent_points()
    assert len(others) == 3
    assert found.multimodal
    x, y, z = found.position.tolist()
    images = [[each, other, z] for each in (x, PLATE.length - x) for other in (y, PLATE.width - y)][1:]
    for each in others:
        assert min(math.dist(image, each.position.tolist()) for image in images) < 2 * found.linking_length


HIGHEST = 2500.0


def plate_field(taps: int, *, copies: int = 1, again: int = 1, apart: float = 0.0) -> SoundField:
    """Return a field of a plate's gains, each mode `copies` times at other pitches: copies err alike.

    Each place is struck `again` times, the later ones beside the first by `apart` of the plate's diagonal.
    """
    contacts = sample_contacts(PLATE, taps, generator=torch.Generator().manual_seed(0)).repeat(again, 1)
    contacts[taps:, 0] += apart * math.hypot(PLATE.length, PLATE.width)
    modes = plate_modes(PLATE, contacts, highest=HIGHEST)
    higher = torch.linspace(1.0, 1.5, copies, dtype=torch.float64).repeat_interleave(len(modes.frequency))
    bank = ModalBank(modes.frequency.repeat(copies) * higher, modes.damping.repeat(copies))
    values = torch.complex(modes.gains, torch.zeros_like(modes.gains)).repeat(1, copies)
    gains = mixture_of(contacts, values, bank=bank, points=plate_surface_points(PLATE, 600))
    return sounding(gains, bank=bank, noise=1e-3, samples=4000)


def test_modes_that_err_alike_tell_no_more_than_one_of_them() -> None:
    # Ten times as many modes tell nothing new; what is thought beforehand keeps the factor from a whole tenth.
    assert calibrate_tempering(plate_field(40, copies=10)) < 0.3 * calibrate_tempering(plate_field(40))


def test_levels_and_edits_change_nothing() -> None:
    field = plate_field(20)
    gains = field.gain_field
    for factor in (1e-14, 1000.0, 1e14):
        louder = replace(field, gain_field=gains.with_values(factor * gains.values))
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


@pytest.mark.parametrize("apart", [0.0, 0.002])
def test_a_contact_in_the_same_place_as_another_is_left_out_with_it(apart: float) -> None:
    # Predicted from itself, an impact would be found to a hair's breadth.
    once, twice = plate_field(12), plate_field(12, again=2, apart=apart)
    assert calibrate_tempering(twice) == pytest.approx(calibrate_tempering(once), rel=0.3)


def test_regions_are_the_wider_the_less_a_mode_counts() -> None:
    field = plate_field(40)
    sound, sizes = field.render(field.gain_field.points[200:201])[0], []
    for factor in (1.0, 0.1, 0.01):
        locator = Locator.of(field)
        vars(locator)["tempering_factor"] = factor
        sizes.append(int(locator.locate(sound).region().sum()))
    assert sizes[0] < sizes[1] < sizes[2]
