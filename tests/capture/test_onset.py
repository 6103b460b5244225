"""When a blow begins, and whether there are two: on constructed sounds and on measured ones."""

from pathlib import Path

import numpy as np
import pytest

from avmsf.capture.audio import read_recording
from avmsf.capture.onset import find_onset, find_pulse, find_second_impact, find_second_push
from factories.capture_folder import ring


@pytest.mark.parametrize("rate", [400, 8000, 48_000, 192_000])
@pytest.mark.parametrize("before", [0.0, 0.001, 0.3, 1.0])
def test_onset_is_found_within_a_quarter_period_of_the_lowest_mode(rate: int, before: float) -> None:
    # Noise 31 dB under the peak, as in the measured bowl clips. The lowest mode has 20 samples a period.
    sound = ring(max(before + 0.5, 200 / rate), rate=rate, before=before, noise=0.01)
    assert abs(find_onset(sound, sample_rate=float(rate)) - before * rate) <= 5


def test_onset_waits_until_the_sound_exceeds_strong_noise() -> None:
    # Noise 22 dB under the peak: a tenth of the peak is only 1.3 of its deviations, which 20 ms of it exceed often.
    sound = ring(1.0, before=0.5)
    peak = np.abs(sound).max()
    sound += peak * 10 ** (-22 / 20) * np.random.default_rng(1).standard_normal(len(sound))
    # The fronts of the five modes reach five deviations within a period of the lowest, 20 samples.
    assert 0 <= find_onset(sound, sample_rate=8000.0) - 4000 <= 20


def test_onset_does_not_follow_the_beat_of_a_doublet() -> None:
    # Two modes 4 Hz apart that start in opposite phase peak 125 ms after the blow.
    rate, before = 48_000, 4800
    time = np.arange(rate) / rate
    beat = np.exp(-3 * time) * (np.sin(2 * np.pi * 1684 * time) - 0.9 * np.sin(2 * np.pi * 1680 * time))
    sound = np.concatenate([np.zeros(before), beat])
    sound += 0.001 * np.random.default_rng(0).standard_normal(len(sound))
    assert np.argmax(np.abs(sound)) - before > 0.05 * rate
    # It cannot be heard sooner than it exceeds a tenth of its peak; 20 ms is how far the search looks back.
    assert abs(find_onset(sound, sample_rate=float(rate)) - before) < 0.05 * rate


def test_a_click_long_before_the_blow_is_not_its_onset() -> None:
    sound = ring(1.0, before=0.5)
    sound[1000] += 0.4 * np.abs(sound).max()
    assert abs(find_onset(sound, sample_rate=8000.0) - 4000) <= 5


@pytest.mark.parametrize("sign", [1, -1])
def test_a_pulse_is_found_whatever_its_sign_and_offset(sign: int) -> None:
    force = np.full(2000, 0.2)
    force[500:531] += sign * 12 * np.sin(np.pi * np.arange(31) / 30)
    force += 0.01 * np.random.default_rng(0).standard_normal(2000)
    pulse = find_pulse(force)
    # A half sine stays above a tenth of its peak for .936 of its length.
    assert (pulse.start, pulse.peak, pulse.stop) == pytest.approx((501, 515, 530), abs=1)
    assert pulse.height == pytest.approx(sign * 12, abs=0.05)
    assert pulse.rest == pytest.approx(0.2, abs=0.002)


@pytest.mark.parametrize(("share", "found"), [(0.2, True), (0.1, False)])
def test_a_second_push_counts_above_15_percent(share: float, found: bool) -> None:
    force = np.zeros(4000)
    hit = np.sin(np.pi * np.arange(31) / 30)
    force[500:531] += 10 * hit
    force[900:931] += 10 * share * hit
    second = find_second_push(force, find_pulse(force), sample_rate=8000.0, seconds=1.0)
    assert (second is not None) == found
    assert second is None or abs(second - 915) < 15
    assert find_second_push(force, find_pulse(force), sample_rate=8000.0, seconds=0.04) is None


@pytest.mark.parametrize("rate", [400, 8000, 48_000])
@pytest.mark.parametrize("level_db", [0, -6, -12])
def test_a_double_hit_is_heard(rate: int, level_db: float) -> None:
    seconds = 3.0 if rate == 400 else 1.0
    sound = ring(seconds, rate=rate, seed=1)
    delay = round(0.3 * seconds * rate)
    assert find_second_impact(sound, 0, sample_rate=float(rate), seconds=seconds) is None
    sound[delay:] += 10 ** (level_db / 20) * ring(seconds, rate=rate, seed=2)[:-delay]
    second = find_second_impact(sound, 0, sample_rate=float(rate), seconds=seconds)
    # Half a window: 5 ms, or 32 samples, and a hop.
    assert second is not None
    assert abs(second - delay) <= max(64, 0.01 * rate)


def test_beating_and_room_noise_are_no_second_blow() -> None:
    rate = 48_000
    time = np.arange(2 * rate) / rate
    modes = [(1681, 1.0), (1684, -0.9), (4155, 0.5), (4170, 0.5), (7297, 0.3), (7369, -0.3), (11_000, 0.2)]
    sound = sum(gain * np.exp(-4 * time) * np.sin(2 * np.pi * frequency * time) for frequency, gain in modes)
    generator = np.random.default_rng(0)
    sound = sound + 1e-3 * generator.standard_normal(len(time))
    sound[rate : rate + 400] += 0.02 * generator.standard_normal(400)
    assert find_second_impact(sound, 0, sample_rate=float(rate), seconds=2.0) is None


@pytest.mark.parametrize(
    ("folder", "earliest", "latest", "spread"),
    [
        # The recorder kept 1 s before each hit. The clips' peaks lie up to 4.3 ms later and 184 samples apart; their
        # onsets agree to .1 ms, 5 samples.
        ("bowl_clips", 1.0, 1.0 + 15 / 48_000, 5 / 48_000),
        ("realimpact_clips", 0.0, 0.015, 0.015),
        ("aircraft_response/impacts", 0.0, 0.015, 0.015),
    ],
)
def test_measured_single_blows_raise_no_alarm(shared, folder, earliest, latest, spread):
    onsets = []
    for path in sorted((shared / folder).glob("*.wav")):
        recording = read_recording(path)
        sound, rate = recording.channels[0], float(recording.sample_rate)
        onset = find_onset(sound, sample_rate=rate)
        assert find_second_impact(sound, onset, sample_rate=rate, seconds=5.0) is None, path.name
        onsets.append(onset / rate)
    assert len(onsets) >= 8
    assert earliest <= min(onsets) <= max(onsets) <= latest
    assert np.ptp(onsets) <= spread + 1e-9


def test_measured_forces_hold_one_push(shared: Path) -> None:
    paths = sorted((shared / "aircraft/impacts").glob("*.wav"))
    assert len(paths) == 74
    for path in paths:
        force = read_recording(path).channels[0]
        pulse = find_pulse(force)
        assert pulse.start in (4, 5), path.name
        assert find_second_push(force, pulse, sample_rate=512.0, seconds=8.0) is None, path.name


@pytest.mark.parametrize("name", ["ceramic", "polycarb", "steel", "wood"])
def test_repeated_measured_blows_are_heard_where_the_force_shows_them(shared: Path, name: str) -> None:
    # Each file holds several hits, the sound in channel 1 and the hammer's force in channel 2.
    recording = read_recording(shared / f"hammer_clips/{name}.wav")
    sound, force = recording.channels
    first = find_pulse(force)
    pushed = find_second_push(force, first, sample_rate=44_100.0, seconds=10.0)
    heard = find_second_impact(sound, first.start, sample_rate=44_100.0, seconds=10.0)
    assert pushed is not None
    assert heard is not None
    # Half of a 10 ms window, and the pulse's own length.
    assert abs(heard - pushed) / 44_100 < 0.008
