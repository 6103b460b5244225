import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from avmsf.capture.audio import Recording
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.localization.locate import locate_impacts
from factories.located_plate import PLATE, RATE, locator_of, missed, struck, true_field
from factories.raising import raises


def overlapping(starts: list[float], strengths: list[float], *, seed: int):
    """Return impacts that ring into one another, and where they fell."""
    impacts = struck(len(starts), seed=seed)
    sound = torch.zeros(round(RATE * (starts[-1] + 0.4)) + 10)
    for start, strength, own in zip(starts, strengths, impacts.sounds, strict=True):
        begin = round(start * RATE)
        sound[begin : begin + len(own)] += strength * own / own.abs().max()
    noise = torch.randn(len(sound), generator=torch.Generator().manual_seed(seed))
    return sound + 1e-3 * noise, impacts.contacts


@pytest.mark.parametrize("strengths", [[1.0, 0.8, 1.2], [0.3, 1.0, -0.7]])
def test_every_impact_is_found_where_and_when_it_fell(strengths):
    starts = [0.1, 0.25, 0.36]
    sound, contacts = overlapping(starts, strengths, seed=31)
    found = locate_impacts(true_field(), sound, locator=locator_of())
    assert [round(seconds, 3) for seconds, _ in found] == pytest.approx(starts, abs=2e-3)
    for (_, each), contact in zip(found, contacts, strict=True):
        assert missed(each, each.most_probable, contact) < 0.05
        assert each.explained_energy > 0.85


def test_noise_and_silence_hold_no_impacts():
    two = Recording("two.wav", np.stack([np.zeros(9000), np.sin(np.arange(9000))]), RATE, "FLOAT")
    with raises(LocationError, file="two.wav", value=0.0):
        locate_impacts(true_field(), two, settings=CaptureSettings(response_channel=1), locator=locator_of())
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(18000))
    with raises(LocationError, name="noise"):
        locate_impacts(true_field(), noise, locator=locator_of())


def test_impacts_on_another_object_are_left_out_and_refused_where_there_are_no_others():
    sound, _ = overlapping([0.1, 0.5], [1.0, 1.0], seed=35)
    other = struck(1, seed=6, plate=replace(PLATE, length=0.4, width=0.31)).sounds[0]
    begin = round(0.5 * RATE)
    mixed = sound.clone()
    mixed[begin:] = 0.0
    mixed[begin : begin + len(other)] = (other / other.abs().max())[: len(mixed) - begin]
    ((seconds, found),) = locate_impacts(true_field(), mixed, locator=locator_of())
    assert round(seconds, 2) == 0.1
    assert re.search(r"the recording: 1 .*, at 0\.5\d\d s, .* a mismatch ratio of", found.notes[-1])
    with raises(LocationError, name="impact", value=pytest.approx(3000 / RATE, abs=0.01)):
        locate_impacts(true_field(), torch.cat([torch.zeros(3000), mixed[begin:]]).numpy(), locator=locator_of())


def test_settings_count_as_for_one_impact():
    sound, contacts = overlapping([0.1, 0.3], [1.0, 0.8], seed=36)
    settings = CaptureSettings(response_channel=2, force_channel=1, normalize="deconvolve")
    # Mono, as a telephone records it: the capture's channels are not asked for, and there is no pulse to divide out.
    mono = Recording("session.wav", sound.double().numpy()[None], RATE, "FLOAT")
    found = locate_impacts(true_field(), mono, settings=settings, locator=locator_of())
    for (_, each), contact in zip(found, contacts, strict=True):
        assert missed(each, each.most_probable, contact) < 0.05
    both = Recording("session.wav", np.stack([0.1 * mono.channels[0][::-1], mono.channels[0]]), RATE, "FLOAT")
    with raises(LocationError, file="session.wav", name="normalize", value="deconvolve"):
        locate_impacts(true_field(), both, settings=settings, locator=locator_of())
    plain = replace(settings, normalize="auto")
    assert len(locate_impacts(true_field(), both, settings=plain, locator=locator_of())) == 2


def noted(push: np.ndarray, sound: torch.Tensor) -> list[bool]:
    """Return which of two impacts, given as 8 N each, have a note on the force channel, which counts 2 N."""
    both = Recording("session.wav", np.stack([push, sound.double().numpy()]), RATE, "FLOAT")
    field = replace(true_field(), origin=replace(true_field().origin, per_newton=True))
    settings = CaptureSettings(force_channel=1, response_channel=2, force_scale=2.0)
    found = locate_impacts(field, both, settings=settings, force=8.0, locator=replace(locator_of(), field=field))
    return [any("force channel" in note for note in each.notes) for _, each in found]


@pytest.mark.parametrize("lead", [0.0, 0.01])
def test_a_force_that_the_force_channel_contradicts_is_noted_for_its_impact(lead):
    starts = [0.1, 0.3]
    sound, _ = overlapping(starts, [1.0, 0.8], seed=36)
    push = 1e-3 * np.random.default_rng(0).standard_normal(len(sound))
    for start, newtons in zip(starts, (8.0, 16.0), strict=True):
        begin = round((start - lead) * RATE) - 4
        push[begin : begin + 9] += 0.5 * newtons * np.sin(np.pi * np.arange(1, 10) / 10)
    assert noted(push, sound) == [False, True]
    # Noise in the force channel is no force.
    noise = np.random.default_rng(0).standard_normal(len(sound))
    assert noted(noise, sound) == noted(0.0 * noise, sound) == [False, False]
