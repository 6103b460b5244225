"""What a field renders: each contact's own sound, in whatever company, at whatever force."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from avmsf.field.sound_field import SoundField
from avmsf.modal.residual_noise import shape_noise
from factories.plate_field import PLATE, QUICK, plate_fit, plate_impacts
from oracles.plate import sample_contacts

CONTACTS = sample_contacts(PLATE, 40, generator=torch.Generator().manual_seed(5))


@cache
def field() -> SoundField:
    config = replace(QUICK, damping="per-contact", warmup_steps=20, steps=4, learning_rate=0.05)
    return plate_fit(config, train=plate_impacts(forces=True))


def test_a_sound_is_its_modes_and_the_noise():
    sound_field = field()
    assert float(sound_field.dampings(CONTACTS).std(0).min()) > 1e-3
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


def test_force_scales_noise_that_is_no_background():
    trained = replace(field(), residual=replace(field().residual, force=None))
    assert torch.equal(trained.render(CONTACTS, forces=4.0), 4.0 * trained.render(CONTACTS))
