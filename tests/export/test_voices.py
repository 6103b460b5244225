"""The real-time bank sounds as the field's render, whatever the blocks, and stays whole when too much is struck."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch

from avmsf.errors import PlayerError
from avmsf.export.player import (
    Blow,
    Keyboard,
    Player,
    bounce,
    comfortable_level,
    endless_blows,
    measure_capacity,
    random_blows,
)
from avmsf.modal.pulse import ForcePulse
from avmsf.modal.voices import CEILING, FLOOR, VoiceBank, turns
from made_tables import MODES, POINTS, RATE, SAMPLES, apart, summed, table

KINDS = [(False, False, False), (True, False, True), (True, True, True)]
FADE = round(0.01 * RATE)


def rendered(field, *blows):
    """Return the sum of what `SampledField.render` gives for each blow, begun where it begins."""
    total = np.zeros(SAMPLES)
    for blow in blows:
        pulse = ForcePulse(blow.contact_time)
        sound = field.render(torch.tensor([blow.row]), force=blow.force, pulse=pulse)[0].double().numpy()
        total[blow.start :] += sound[: SAMPLES - blow.start]
    return total


def played(field, *blows, block, floor=0.0, voices=32, limit=False, samples=SAMPLES):
    player = Player(field, voices=voices, level=1.0, floor=floor)
    for blow in blows:
        player.strike(blow)
    counts = [block] * (samples // block) + [samples % block] * (samples % block > 0)
    return np.concatenate([player.render(count, limit=limit) for count in counts]).astype(np.float64)


@pytest.mark.parametrize(("phased", "spatial", "noisy"), KINDS)
@pytest.mark.parametrize("block", [64, 101, SAMPLES])
def test_blows_that_overlap_sound_as_rendered(phased, spatial, noisy, block):
    field = table(phased=phased, spatial=spatial, noisy=noisy)
    blows = Blow(3), Blow(5, 0.3, 77), Blow(3, 2.0, 78, 0.0021), Blow(0, 1.0, 1000, 0.0004)
    kept = SAMPLES - FADE  # the first blow's noise ends with a fade there
    assert apart(played(field, *blows, block=block)[:kept], rendered(field, *blows)[:kept]) < 1e-6


def test_one_mode_is_the_plain_sum_for_minutes():
    """A recursion in double precision keeps its phase: after two minutes within 1e-9."""
    rate, samples = 44100.0, 44100 * 120
    turn = turns(np.array([3300.1]), np.array([0.02]), sample_rate=rate)
    bank = VoiceBank(sample_rate=rate, noise=np.zeros(1, np.float32))
    bank.strike("a", turn, np.array([0.3 + 0.4j]))
    heard = np.concatenate([bank.render(4410, limit=False) for _ in range(samples // 4410)])[-1000:]
    times = np.arange(samples - 1000, samples) / rate
    angle = 2 * np.pi * 3300.1 * times
    true = np.exp(-0.02 * times) * (0.3 * np.sin(angle) + 0.4 * np.cos(angle))
    assert np.abs(heard - true).max() < 1e-7


def test_transposed_blows_have_other_pitches_and_the_same_decay():
    field = table()
    heard = played(field, Blow(2, ratio=1.5), block=64)
    frequency = 1.5 * field.frequency.numpy()
    amplitude = np.where(frequency < RATE / 2, field.sine[2].numpy(), 0.0)
    assert frequency[-1] > RATE / 2
    assert apart(heard, summed(amplitude, np.zeros(MODES), frequency, field.damping)) < 1e-6


def test_modes_that_nobody_hears_are_dropped_and_nothing_else():
    field = replace(table(), damping=torch.tensor([300.0, 400.0, 2000.0, 9.0], dtype=torch.float64))
    blows = Blow(3), Blow(5, 1.0, 500), Blow(3, 1e-5, 501)
    whole, culled = (played(field, *blows, block=64, floor=floor) for floor in (0.0, FLOOR))
    assert 0 < np.abs(whole - culled).max() < 3 * MODES * FLOOR
    player = Player(field, level=1.0)
    player.strike(Blow(3))
    heard = [player.render(2000).any() for _ in range(9)]
    # exp(-9 t) falls below the floor after 1.8 s, and with it all is silent, exactly.
    assert heard[0]
    assert not heard[-1]
    assert player.ringing == 0


@pytest.mark.parametrize("voices", [1, 3])
def test_the_faintest_voice_makes_room_without_a_click(voices):
    # Points of their own dampings need a voice each.
    field = replace(table(spatial=True), frequency=torch.tensor([10.0, 13.0, 16.0, 20.0], dtype=torch.float64))
    field.sine[:] = torch.linspace(0.3, 1.0, POINTS)[:, None]
    blows = [Blow(row, 1.0, 150 * row) for row in range(POINTS)]
    player = Player(field, voices=voices, level=1.0)
    for blow in blows:
        player.strike(blow)
    heard, most = [], 0
    for _ in range(SAMPLES // 50):
        heard.append(player.render(50, limit=False))
        most = max(most, player.ringing)
    # One that fades beside those that stay.
    assert voices <= most <= voices + 1
    heard = np.concatenate(heard)
    # A click would be a step of about 1; the steepest that such slow modes can do, even fading, is far less.
    steepest = MODES * (2 * np.pi * 20 / RATE + 1 / FADE)
    assert np.abs(np.diff(heard)).max() < (voices + 1) * steepest
    if voices == 1:
        last = blows[-1].start + FADE
        assert apart(heard[last:], rendered(field, blows[-1])[last:]) < 1e-5


def test_shared_dampings_need_one_voice_for_any_number_of_blows():
    field = table()
    blows = [Blow(place % POINTS, 0.1, 3 * place) for place in range(400)]
    player = Player(field, voices=1, level=1.0, floor=0.0)
    for blow in blows:
        player.strike(blow)
    heard = np.concatenate([player.render(64, limit=False) for _ in range(SAMPLES // 64)])
    assert player.ringing == 1
    assert apart(heard, rendered(field, *blows)) < 1e-5


def test_the_limiter_leaves_alone_what_is_not_too_loud():
    field = table(phased=True)
    peak = np.abs(rendered(field, Blow(4))).max()
    just = Blow(4, 0.999 * CEILING / peak)
    np.testing.assert_array_equal(played(field, just, block=64, limit=True), played(field, just, block=64))


def test_nothing_is_louder_than_the_ceiling_and_the_level_comes_back():
    field = replace(table(phased=True), damping=torch.full((MODES,), 60.0, dtype=torch.float64))
    blows = Blow(4, 50.0), Blow(4, 0.01, 12_000)
    heard = played(field, *blows, block=64, limit=True, samples=14_000)
    assert np.abs(heard).max() <= CEILING * (1 + 1e-6)
    # 12,000 samples are 15 times the limiter's release.
    later = played(field, blows[1], block=64, samples=14_000)[12_000:]
    assert apart(heard[12_000:], later) < 1e-4


def test_the_noise_ends_without_a_click():
    field = table(noisy=True)
    field.noise[:] = 0.5
    field.sine[:] = 0.0
    heard = played(field, Blow(0), block=64, samples=SAMPLES + 100)
    assert (heard[: SAMPLES - FADE] == 0.5).all()
    assert np.abs(np.diff(heard)[5:]).max() < 0.5 / FADE * 1.01
    assert not heard[SAMPLES:].any()


def test_of_too_many_noises_the_faintest_dies_away():
    field = table(noisy=True)
    field.sine[:] = 0.0
    blows = Blow(0, 1.0), Blow(0, 0.1, 10), Blow(0, 2.0, 20)
    heard = played(field, *blows, block=1, voices=2)
    np.testing.assert_allclose(heard[:20], rendered(field, *blows)[:20], atol=1e-8)
    loud = rendered(field, blows[0], blows[2])
    assert apart(heard[20 + FADE : SAMPLES - FADE], loud[20 + FADE : SAMPLES - FADE]) < 1e-6


@pytest.mark.parametrize("block", [1, 64])
def test_a_noise_that_makes_room_does_not_click(block):
    """A constant instead of noise: whatever steps then, beside the blows' own beginnings, is a click."""
    field = table(noisy=True)
    field.noise[:] = 0.5
    field.sine[:] = 0.0
    blows = Blow(0, 1.0), Blow(0, 2.0, 640), Blow(0, 3.0, 1000), Blow(0, 0.1, 1001)
    heard = played(field, *blows, block=block, voices=1)
    steps = np.diff(heard)
    steps[[639, 999]] -= [1.0, 1.5]
    assert np.abs(steps).max() < 1.01 * (1.0 + 2.0) * 0.5 / FADE
    # The last is fainter than what sounds, and is never heard; the others are gone after their fading.
    np.testing.assert_allclose(heard[1001 + FADE : SAMPLES], 1.5, atol=1e-6)


def test_the_chosen_level_leaves_room():
    field = table(phased=True)
    player = Player(field)
    for row in range(POINTS):
        player.strike(Blow(row, 1.0, row * SAMPLES))
    heard = np.concatenate([player.render(SAMPLES) for _ in range(POINTS)])
    assert np.abs(heard).max() == pytest.approx(0.25, rel=0.02)
    silent = replace(field, sine=torch.zeros_like(field.sine), cosine=torch.zeros_like(field.sine))
    assert comfortable_level(silent) == 1.0


def test_chance_has_a_seed_and_a_rate():
    field = table()
    blows = random_blows(field, seconds=200.0, each_second=5.0, seed=3)
    assert blows == random_blows(field, seconds=200.0, each_second=5.0, seed=3)
    assert blows != random_blows(field, seconds=200.0, each_second=5.0, seed=4)
    assert len(blows) == pytest.approx(1000, abs=4 * 1000**0.5)
    assert blows[0].start == 0
    assert all(blow.start < 200 * RATE for blow in blows)
    # They are the first of those without end.
    endless = endless_blows(field, each_second=5.0, seed=3)
    assert list(islice(endless, len(blows))) == blows
    assert next(endless).start >= 200 * RATE
    assert {blow.row for blow in blows} == set(range(POINTS))
    decibels = 20 * np.log10([blow.force for blow in blows])
    assert decibels.std() == pytest.approx(6.0, rel=0.1)


def test_keys_are_contacts_or_pitches():
    field = table()
    contacts = Keyboard(field)
    assert {contacts.blow(note, 100, start=0).row for note in range(36, 36 + POINTS)} == set(range(POINTS))
    soft, middle = (contacts.blow(36, velocity, start=9).force for velocity in (50, 100))
    assert (soft, middle) == (0.25, 1.0)
    pitches = Keyboard(field, keys="pitch", row=4, contact_time=0.001)
    octave = pitches.blow(72, 100, start=5)
    assert (octave.row, octave.ratio, octave.start, octave.contact_time) == (4, pytest.approx(2.0), 5, 0.001)
    assert pitches.blow(60, 100, start=0).ratio == 1.0


@pytest.mark.parametrize("tried", [5, 16])
def test_the_capacity_is_that_of_the_field(monkeypatch, tried):
    """On a clock by which a voice takes a microsecond a sample, and a blow a quarter of a millisecond."""
    clock, begun = [0.0], [0]

    def render(self, count, *, limit=True):
        sound = plain(self, count, limit=limit)
        clock[0] += 1e-6 * count * self.ringing + 2.5e-4 * max(0, begun[0] - tried)
        begun[0] = 0
        return sound

    def strike(self, blow):
        begun[0] += 1
        plain_strike(self, blow)

    plain, plain_strike = Player.render, Player.strike
    monkeypatch.setattr(Player, "render", render)
    monkeypatch.setattr(Player, "strike", strike)
    monkeypatch.setattr("avmsf.export.player.time.process_time", lambda: clock[0])
    for field in (table(), table(spatial=True)):
        assert measure_capacity(field, seconds=0.2, tried=tried).voices == int(1e6 / RATE)
    assert np.isnan(measure_capacity(table(spatial=True), seconds=0.2, tried=tried).blows)
    # A thousand blows, and .2 s (6 blocks of 256) of the one voice that they ring in.
    taken = 2.5e-4 * (1000 - tried) + 1e-6 * 6 * 256
    assert measure_capacity(table(), seconds=0.2, tried=tried).blows == pytest.approx(1000 / taken, rel=1e-9)


def test_what_cannot_be_is_refused():
    field = table()
    player = Player(field)
    player.render(64)
    with pytest.raises(PlayerError, match="expected one of points 0 to 8, found 9"):
        player.strike(Blow(9, start=64))
    with pytest.raises(PlayerError, match="a blow from sample 64 on, found one at 63"):
        player.strike(Blow(0, start=63))
    with pytest.raises(PlayerError, match="1 voice or more, found 0"):
        Player(field, voices=0)
    with pytest.raises(PlayerError, match="a level above 0, found -1"):
        Player(field, level=-1.0)
    for settings in ({"seconds": 0.0}, {"each_second": float("inf")}, {"force": -1.0}):
        with pytest.raises(PlayerError, match="above 0, found"):
            random_blows(field, **{"seconds": 1.0, "each_second": 1.0, "seed": 0, **settings})
    assert len(bounce(Player(field), [], 130)) == 130
