"""What a field renders, and how well it knows the places between its contacts."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from avmsf.evaluation.scores import evaluate
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.next_contacts import suggest
from avmsf.field.quality import FieldQuality, smallest_within_error
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.modal.extraction.extract import extract_modes
from avmsf.modal.residual_noise import shape_noise
from factories.delayed_plate import SAMPLES, strikes
from factories.plate_field import PLATE, QUICK, plate_fit, plate_impacts
from oracles.plate import sample_contacts

CONTACTS = sample_contacts(PLATE, 40, generator=torch.Generator().manual_seed(5))


@cache
def field() -> SoundField:
    config = replace(QUICK, damping="per-contact", warmup_steps=20, steps=4, learning_rate=0.05)
    return plate_fit(config, train=plate_impacts(forces=True))


def test_a_sound_is_its_modes_and_the_noise():
    sound_field = field()
    assert float(sound_field.known(CONTACTS).dampings(sound_field.bank.damping).std(0).min()) > 1e-3
    sounds = sound_field.render(CONTACTS)
    noise = (sounds - sound_field.render(CONTACTS, noise=False)).double()
    # Float32 sounds: the same noise is left at all contacts, to a millionth of the loudest sample.
    torch.testing.assert_close(noise, noise[:1].expand(40, -1), rtol=0, atol=1e-6 * float(sounds.abs().max()))
    assert torch.equal(sound_field.render(CONTACTS), sounds)
    # Its variance is the mean of the squared magnitudes, between bins on the lines that join them.
    low, high = sound_field.residual.magnitude[:-1], sound_field.residual.magnitude[1:]
    level = float(((low.square() + low * high + high.square()) / 3).mean().sqrt())
    # 2400 samples tell it to 2 % where it is white, and to less where few bands hold most of it.
    assert float(noise[0].std()) == pytest.approx(0.78 * level, rel=0.15)


def test_without_noise_a_sound_is_its_modes():
    sound_field = field()
    silent = replace(sound_field, residual=replace(sound_field.residual, magnitude=torch.zeros(33)))
    assert torch.equal(sound_field.render(CONTACTS, noise=False), silent.render(CONTACTS))
    recordings = torch.ones(len(sound_field.origin.trained_on), 2400)
    recorded = replace(sound_field, residual=replace(sound_field.residual, recordings=recordings))
    assert torch.equal(recorded.render(CONTACTS, noise=False), silent.render(CONTACTS))


def test_gaussian_noise_is_the_draw_of_the_fits_seed():
    config = replace(field().origin.config, residual_noise="gaussian")
    sound_field = replace(field(), origin=replace(field().origin, config=config))
    generator = torch.Generator().manual_seed(sound_field.origin.config.seed)
    magnitude = sound_field.residual.magnitude
    assert torch.equal(sound_field.noise(), shape_noise(magnitude, contacts=1, samples=2400, generator=generator)[0])
    # The rendered sound contains it, to what float32 leaves of it beside the modes.
    rest = sound_field.render(CONTACTS) - field().render(CONTACTS)
    expected = (sound_field.noise() - field().noise()).expand(40, -1)
    torch.testing.assert_close(rest, expected, rtol=0, atol=1e-3 * float(expected.std()))


@pytest.mark.parametrize("rows", [[0], [7], [3, 39], list(range(39, -1, -1)), list(range(33))])
def test_a_contacts_sound_does_not_depend_on_its_company(rows):
    """More contacts than one batch, one alone, the last one of a batch: to the rounding of other orders of sums."""
    sounds = field().render(CONTACTS)
    loudest = float(sounds.abs().max())
    torch.testing.assert_close(field().render(CONTACTS[rows]), sounds[rows], rtol=0, atol=1e-6 * loudest)


def test_force_scales_the_modes_and_leaves_the_background():
    assert field().residual.force == 2.0
    modes, noise = field().render(CONTACTS, noise=False), field().noise()
    assert torch.equal(field().render(CONTACTS), modes + noise)
    assert torch.equal(field().render(CONTACTS, forces=4.0), 4.0 * modes + 2.0 * noise)
    assert torch.equal(field().render(CONTACTS, forces=0.0), (2.0 * noise).expand(40, -1))
    forces = torch.linspace(0.1, 4.0, 40)
    assert torch.equal(field().render(CONTACTS, forces=forces), forces[:, None] * modes + 2.0 * noise)


CONFIG = FitConfig(warmup_steps=0, steps=3)


def parted(*, clicks: bool = False):
    """Return 16 recordings to fit to and 4 others, without their margins: they are aligned.

    With clicks, all of them have the same burst, which no mode explains.
    """
    final = replace(strikes(20), before=None, after=None)
    if clicks:
        burst = 0.3 * torch.randn(SAMPLES, generator=torch.Generator().manual_seed(1))
        burst[300:] = 0.0
        final = replace(final, sounds=final.sounds + burst)
    return final.take(range(16)), final.take(range(16, 20))


@cache
def modes(*, clicks: bool = False):
    return extract_modes(parted(clicks=clicks)[0])


def fitted(train, modes, config=CONFIG):
    return fit(train, FeatureField.from_contacts(strikes(20).contacts, count=300), modes, config)


@cache
def plain() -> SoundField:
    return fitted(parted()[0], modes())


def test_the_error_at_contacts_left_out_is_about_that_at_new_ones():
    (train, test), field = parted(), plain()
    # Two of the sixteen contacts are in one place.
    assert field.quality.positions == 15
    assert field.quality.error < field.quality.nearest_mean
    new = evaluate(field, test).mean()["relative_stft"]
    assert new / 2 < field.quality.error < 2 * new
    averaged = evaluate(MeanWaveform(train), test).mean()["relative_stft"]
    assert averaged / 2 < field.quality.nearest_mean < 2 * averaged


def test_repeats_at_a_position_do_not_count_as_independent():
    train, _ = parted()
    once, twice = (fitted(train.take(rows), modes().take(rows)).quality for rows in ([*range(14)], [*range(14)] * 2))
    assert once.positions == twice.positions
    assert twice.standard_error == pytest.approx(once.standard_error, rel=0.1)


def test_what_recordings_have_in_common_beside_their_modes_is_kept(tmp_path):
    train, test = parted(clicks=True)
    field = fitted(train, modes(clicks=True))
    assert field.residual.recordings is not None
    report = field.origin.report["residual"]
    assert report["recordings"] < report["noise"]
    noisy = replace(field, residual=replace(field.residual, recordings=None))
    errors = [evaluate(each, test).mean()["relative_stft"] for each in (field, noisy)]
    assert errors[0] < 0.8 * errors[1]
    save(field, tmp_path / "field.safetensors")
    known = load(tmp_path / "field.safetensors")
    assert torch.equal(known.render(test.contacts), field.render(test.contacts))
    # What an impact adds grows with its force, as the modes do. A mean of three has a third of the background's power.
    earlier = replace(field, residual=replace(field.residual, force=None))
    (plain, full), noise = ([each.render(test.contacts) for each in (earlier, field)]), field.noise()
    torch.testing.assert_close(full - plain, math.sqrt(2 / 3) * noise.expand(len(test), -1), rtol=0, atol=1e-6)
    expected = 0.5 * plain + math.sqrt(1 - 0.25 / 3) * noise
    torch.testing.assert_close(field.render(test.contacts, forces=0.5), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(field.render(test.contacts, forces=4.0), 4.0 * plain)
    # Longer than the recordings there is silence, as beyond their end nothing is known.
    assert torch.equal(known.render(test.contacts, samples=SAMPLES + 50)[:, :100], known.render(test.contacts)[:, :100])


def test_the_smallest_share_is_taken_that_is_not_surely_worse_than_the_best():
    sign = torch.tensor([1.0, -1.0, 1.0, -1.0])
    best = 0.7 + 0.1 * sign
    # Standard errors of the differences are .058 and .115.
    assert smallest_within_error(torch.stack([best + 0.3 - 0.1 * sign, best + 0.1 + 0.2 * sign, best])) == 1
    assert smallest_within_error(torch.stack([best + 0.3 - 0.1 * sign, best + 0.2 + 0.2 * sign, best])) == 2


def test_where_places_say_nothing_the_spread_counts_and_new_sounds_are_nearer():
    recorded = replace(strikes(20), before=None, after=None)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(0))
    mixed = replace(recorded, contacts=recorded.contacts[order])
    train, test = mixed.take(range(16)), mixed.take(range(16, 20))
    field = fitted(train, modes())
    assert field.gain_field.spread_share > 0.0
    means = replace(field, gain_field=replace(field.gain_field, spread_share=0.0))
    with_spread, without = (evaluate(each, test).mean()["relative_stft"] for each in (field, means))
    assert with_spread < 0.98 * without


def test_without_a_residual_none_is_kept():
    field = fitted(parted(clicks=True)[0], modes(clicks=True), replace(CONFIG, residual=False))
    assert field.residual.recordings is None
    assert not field.residual.magnitude.any()
    assert set(field.origin.report["residual"]) == {"noise"}


def test_independent_noise_is_rendered_as_noise():
    train, _ = parted()
    noise = 0.05 * torch.randn(train.sounds.shape, generator=torch.Generator().manual_seed(2))
    train = replace(train, sounds=train.sounds + noise)
    assert fitted(train, extract_modes(train)).residual.recordings is None


@pytest.mark.parametrize("count", [2, 3])
def test_few_places_say_nothing_of_quality(count):
    assert fitted(parted()[0].take(range(count)), modes().take(range(count))).quality is None


def test_an_edited_field_has_no_quality_and_its_surroundings_no_next_contact():
    field = plain()
    # The points fill the box of the contacts: many of them are not on any object.
    assert field.quality.next_contact is None
    edited = replace(field, origin=replace(field.origin, report={**field.origin.report, "edits": [{"edit": "x"}]}))
    assert edited.quality is None


def test_the_next_contact_is_where_no_contact_is_and_lowers_the_expected_error_most(tmp_path):
    train = parted()[0]
    # Nothing was recorded on the right half of the plate.
    rows = torch.nonzero(train.contacts[:, 0] < 0.5).flatten().tolist()
    left = train.take(rows)
    side = torch.linspace(0.0, 1.0, 30)
    plate = torch.cat([torch.cartesian_prod(side, side), torch.zeros(900, 1)], 1)
    field = fit(left, FeatureField.from_points(plate), modes().take(rows), CONFIG)
    assert field.quality.next_contact[0] > 0.5
    contact = torch.tensor(field.quality.next_contact, dtype=torch.float64)
    assert field.quality.next_distance == pytest.approx(float((left.contacts - contact).norm(dim=1).min()))
    # What `avmsf suggest` names first.
    assert torch.equal(suggest(field, 1).contacts[0], contact)
    save(field, tmp_path / "field.safetensors")
    assert load(tmp_path / "field.safetensors").quality == field.quality


@pytest.mark.parametrize(("nearest", "mean"), [(None, 0.7), (0.9, 0.7), (0.7, 0.9)])
@pytest.mark.parametrize(("error", "level"), [(0.5, 0), (0.66, 1), (0.74, 1), (0.76, 2)])
def test_the_level_of_quality_asks_for_a_standard_error(error, level, nearest, mean):
    found = FieldQuality(9, error, mean, standard_error=0.05, nearest=nearest)
    assert found.level == level
    assert found.verdict.startswith("Warning") == (level > 0)
