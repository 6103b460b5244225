"""Recordings of one impact and of several: their onsets, rates, channels and what is noted."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import torch

from avmsf.capture.audio import Recording
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.localization.locate import locate, locate_impacts
from avmsf.localization.locator import Locator
from avmsf.localization.preprocess import at_field_rate, preprocess_recording
from factories.located_plate import PLATE, RATE, locator_of, missed, struck, true_field
from factories.raising import raises


def recorded(sound: torch.Tensor) -> Recording:
    """Return the sound with faint noise before it and beneath, as it would come from a recorder."""
    samples = np.concatenate([np.zeros(round(0.1 * RATE)), sound.double().numpy()])
    noise = 1e-3 * np.abs(samples).max() * np.random.default_rng(0).standard_normal(len(samples))
    return Recording("hit.wav", (0.5 * (samples + noise) / np.abs(samples).max())[None], RATE, "FLOAT")


def read_by(settings: CaptureSettings) -> SoundField:
    """Return the plate's field, its own recordings read by these settings."""
    return replace(true_field(), origin=replace(true_field().origin, settings=settings))


def test_the_onset_is_found_and_the_impact_located():
    impacts = struck(6, seed=21)
    for sound, contact in zip(impacts.sounds, impacts.contacts, strict=True):
        impact = preprocess_recording(recorded(sound), true_field())
        assert abs(len(impact[0]) - len(sound)) <= 8
        assert impact[2] == []
        found = locate(true_field(), recorded(sound), locator=locator_of())
        assert missed(found, found.most_probable, contact) < 0.03
        assert found.modal_energy > 0.95


def test_a_field_of_sounds_from_their_peaks_is_asked_for_sounds_from_their_peaks():
    field, one = read_by(CaptureSettings(time_zero="peak")), recorded(struck(1, seed=21).sounds[0])
    locator = Locator.of(field)
    by_file = locate(field, one, locator=locator)
    for found in (locate(field, one.channels[0], locator=locator), locate_impacts(field, one, locator=locator)[0][1]):
        assert torch.allclose(found.distance, by_file.distance, atol=1e-3)
    # Settings of another recording do not move its start.
    assert torch.equal(locate(field, one, locator=locator, settings=CaptureSettings()).distance, by_file.distance)


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_clipping_is_noted_whatever_the_recorders_offset(offset):
    one = recorded(struck(1, seed=3).sounds[0])
    loud = replace(one, channels=np.clip(5.0 * one.channels + offset, -1.0, 1.0))
    assert "clipped at 1" in preprocess_recording(loud, true_field())[2][0]


@pytest.mark.parametrize("rate", [44100.0, 48000.0, 12000.0])
def test_another_rate_is_resampled_and_said(rate):
    impacts = struck(1, seed=22)
    sound = recorded(impacts.sounds[0]).channels[0]
    samples = scipy.signal.resample_poly(sound, round(rate / 100), round(RATE / 100))
    impact = preprocess_recording(torch.from_numpy(samples), true_field(), sample_rate=rate)
    assert f"resampled from {rate:g} Hz to the field's 18000 Hz" in impact[2][0]
    located_by = re.findall(r"located by (\d+) of .* above 5400 Hz are left out", impact[2][0])
    assert located_by == ([str(int((true_field().bank.frequency < 5400.0).sum()))] if rate == 12000.0 else [])
    found = locate(true_field(), torch.from_numpy(samples), sample_rate=rate, locator=locator_of())
    assert missed(found, found.most_probable, impacts.contacts[0]) < 0.03
    assert found.modal_energy > 0.9


@pytest.mark.parametrize("noise_db", [0.0, 3.0])
def test_bands_that_resampling_emptied_are_not_taken_for_quiet(noise_db):
    """Half the rate holds half of the noise, which is as loud as the impact is and no other object's sound."""
    for seed in (51, 52):
        sound = struck(1, seed=seed, noise_db=noise_db).sounds[0].double().numpy()
        halved = scipy.signal.resample_poly(sound, 1, 2)
        impact = at_field_rate(halved, Recording("half.wav", halved[None], RATE / 2, "FLOAT"), true_field())
        found = locator_of().locate(impact[0], highest=impact[1])
        assert found.mismatch_ratio < 0.25


def test_how_hard_a_blow_was_is_x_its_push_was_recorded():
    one = recorded(struck(1, seed=25).sounds[0]).channels[0]
    push = np.zeros_like(one)
    push[1800:1809] = np.sin(np.pi * np.arange(1, 10) / 10)
    sound = scipy.signal.fftconvolve(one, push[1800:1809])[: len(one)]
    settings = CaptureSettings(force_channel=1, response_channel=2, normalize="deconvolve")
    both = (Recording("hit.wav", force * np.stack([push, sound]), RATE, "FLOAT") for force in (0.02, 0.4))
    soft, hard = (preprocess_recording(each, true_field(), settings=settings) for each in both)
    assert float(hard[0].norm() / soft[0].norm()) == pytest.approx(20.0, rel=1e-3)


def test_a_second_impact_is_noted_and_not_used():
    impacts = struck(2, seed=24)
    both = torch.cat([impacts.sounds[0][:5400], impacts.sounds[1]])
    found = locate(true_field(), recorded(both), locator=locator_of())
    assert [float(each) for each in re.findall(r"([\d.]+) s\b", found.notes[0])] == pytest.approx([0.1, 0.4], abs=0.01)
    assert missed(found, found.most_probable, impacts.contacts[0]) < 0.03


def test_channels_follow_the_capture_where_the_recording_has_them():
    one = recorded(struck(1, seed=25).sounds[0]).channels[0]
    two = Recording("hit.wav", np.stack([0.1 * one[::-1], one]), RATE, "FLOAT")
    with raises(LocationError, file="hit.wav", name="response_channel", value=2):
        preprocess_recording(two, true_field())
    settings = CaptureSettings(response_channel=2, highpass=30.0)
    assert abs(len(preprocess_recording(two, true_field(), settings=settings)[0]) - (len(one) - 1800)) <= 8
    # What the field was fitted to was read so, though from its first sample on: an impact is sought all the same.
    like = read_by(replace(settings, align=False))
    torch.testing.assert_close(
        preprocess_recording(two, like)[0], preprocess_recording(two, true_field(), settings=settings)[0]
    )
    alone = preprocess_recording(Recording("hit.wav", one[None], RATE, "FLOAT"), true_field(), settings=settings)
    torch.testing.assert_close(alone[0], preprocess_recording(two, true_field(), settings=settings)[0])
    hammered = CaptureSettings(force_channel=1, response_channel=2, highpass=30.0, normalize="deconvolve")
    pushless = preprocess_recording(Recording("hit.wav", one[None], RATE, "FLOAT"), true_field(), settings=hammered)
    torch.testing.assert_close(pushless[0], alone[0])
    with raises(LocationError, file="hit.wav", name="sample_rate", value=8000.0):
        preprocess_recording(two, true_field(), sample_rate=8000.0)


def test_bare_samples_are_taken_as_they_are_and_files_as_the_capture_was():
    sped = CaptureSettings(playback_speed=2.0)
    like = read_by(sped)
    whole = recorded(struck(1, seed=25).sounds[0])
    torch.testing.assert_close(
        preprocess_recording(whole.channels[0], like)[0], preprocess_recording(whole.channels[0], true_field())[0]
    )
    slow = replace(whole, sample_rate=whole.sample_rate / 2)
    torch.testing.assert_close(preprocess_recording(slow, like)[0], preprocess_recording(whole, true_field())[0])


def test_a_recording_that_starts_with_its_impact_is_read_as_those_of_a_capture_that_was_not_cut():
    """The first sample of a sine is zero, so that an onset is found behind it, where nothing was cut before."""
    field = true_field()
    uncut = read_by(replace(field.origin.settings, align=False))
    sound = struck(1, seed=21).sounds[0].double()
    # Some samples that a threshold does not reach.
    whole = Recording("hit.wav", torch.cat([1e-4 * sound[:5], sound]).numpy()[None], RATE, "FLOAT")
    assert len(preprocess_recording(whole, uncut)[0]) == len(sound) + 5
    assert len(preprocess_recording(whole, field)[0]) < len(sound) + 5
    later = recorded(sound)
    assert len(preprocess_recording(later, uncut)[0]) == len(preprocess_recording(later, field)[0])


HIT = recorded(struck(1, seed=1).sounds[0]).channels[0][::40].copy()
NOISE, HUM = torch.randn(9000, generator=torch.Generator().manual_seed(1)), torch.sin(0.3 * torch.arange(9000))


@pytest.mark.parametrize(
    ("samples", "rate", "attributes"),
    [
        (NOISE, None, {"file": "the recording"}),
        (HUM, None, {"file": "the recording"}),
        (NOISE[None], None, {"name": "recording", "value": [1, 9000]}),
        (torch.tensor(1.0), None, {"name": "recording", "value": []}),
        (HIT, 450.0, {"name": "sample_rate", "value": 450.0}),
        *((NOISE, rate, {"name": "sample_rate", "value": rate}) for rate in (math.inf, 0.0, -8000.0)),
    ],
)
def test_recordings_that_hold_no_impact_or_no_mode_are_refused(samples, rate, attributes):
    with raises(LocationError, **attributes):
        preprocess_recording(samples, true_field(), sample_rate=rate)


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


@pytest.mark.parametrize("times", [2, 4])
def test_impacts_of_a_finer_sampled_session_are_where_they_were(times):
    sound, _ = overlapping([0.1, 0.25, 0.36], [1.0, 0.8, 1.2], seed=31)
    finer = scipy.signal.resample_poly(sound.double().numpy(), times, 1)
    found = locate_impacts(true_field(), finer, sample_rate=times * RATE, locator=locator_of())
    whole = locate_impacts(true_field(), sound, locator=locator_of())
    for (seconds, one), (expected, other) in zip(found, whole, strict=True):
        assert abs(seconds - expected) < 2.5 / RATE
        assert one.explained_energy == pytest.approx(other.explained_energy, abs=0.03)
