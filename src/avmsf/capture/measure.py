"""Quality of one recording: its length, level, noise, clipping, onset and second impacts; and whether it is of one."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from avmsf._utils.text import counted
from avmsf.capture.audio import EIGHT_BIT, LOSSLESS, Recording, clipped_samples
from avmsf.capture.issues import RecordingReport
from avmsf.capture.onset import SECONDS_BEFORE, find_second_impact, find_second_push
from avmsf.capture.prepare import Prepared, prepare, remove_rumble, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError

HIGHEST_NOISE_DB = -20.0
"""Noise above this, against the peak, leaves too little of the decay to measure."""
LOWEST_PEAK_DB = -50.0
"""An integer file below this uses so few of its steps that it was recorded too softly."""

_MIN_RISE = 10 ** (6.0 / 20.0)
"""How far the loudest hundredth of a second must stand above the quietest, 6 dB: the least that an impact does."""


def measure(recording: Recording, prepared: Prepared, *, settings: CaptureSettings, line: int) -> RecordingReport:
    """Measure one recording that could be read and prepared, and say what about it looks wrong."""
    rate = recording.sample_rate
    channel = recording.response_channel(settings.response_channel, force_channel=settings.force_channel)
    response, seconds = recording.channel(channel), settings.kept_seconds(rate)
    # An offset, and rumble that the settings remove, are not in the sounds.
    sound = recording.response(channel)
    level = decibels(float(np.abs(sound).max()))
    filtered = remove_rumble(sound, settings.highpass, recording)
    noise = decibels(noise_level(filtered, prepared.onset, rate) / float(np.abs(filtered).max()))
    clipped = clipped_samples(response)
    if settings.force_channel is not None:
        clipped += clipped_samples(recording.channel(settings.force_channel))
    kept = filtered[prepared.onset : prepared.onset + round(seconds * rate)]
    second = _second_impact(kept, prepared.onset, recording, prepared, settings.force_channel)
    others = (each for row, each in enumerate(recording.channels, 1) if row not in (channel, settings.force_channel))
    problems = []
    if settings.response_channel is None and any(not np.array_equal(each, response) for each in others):
        problems.append(
            f"its channels hold one sound, up to a constant factor and rounding: channel {channel} is used; to choose "
            "another, write response_channel in capture.toml"
        )
    if clipped:
        problems.append(f"{counted(clipped, 'clipped sample')}: record it again with less gain, or remove its row")
    if second is not None:
        problems.append(f"a second impact at {second / rate:.3f} s: record it again, or reduce seconds")
    if noise > HIGHEST_NOISE_DB:
        problems.append(
            f"its noise is only {-noise:.0f} dB below the peak: noisy, no clear impact, or cut before it has decayed"
        )
    if recording.subtype in EIGHT_BIT:
        problems.append(f"only 8 bits a sample ({recording.subtype}): its noise hides the decay; record 16 or more")
    elif not recording.subtype.startswith(LOSSLESS):
        problems.append(f"compressed with loss ({recording.subtype}): soft parts of the decay are altered; record wav")
    elif recording.subtype.startswith("PCM") and level < LOWEST_PEAK_DB:
        problems.append(f"its peak is {-level:.0f} dB below full scale: turn the gain up")
    return RecordingReport(
        file=recording.name,
        line=line,
        readable=True,
        problems=tuple(problems),
        seconds=recording.duration,
        sample_rate=rate,
        channels=len(recording.channels),
        coding=recording.subtype,
        peak_db=level,
        noise_db=noise,
        onset_seconds=prepared.onset / rate,
        clipped=clipped,
        double_hit_seconds=None if second is None else second / rate,
    )


def _second_impact(
    sound: Float64[np.ndarray, " frames"], begin: int, recording: Recording, prepared: Prepared, channel: int | None
) -> int | None:
    """Return the sample of a file at which the object was struck again: by the force's channel, or by its sound.

    Within the length of `sound`, which is that of the file from sample `begin` on.
    """
    rate, seconds = recording.sample_rate, len(sound) / recording.sample_rate
    if prepared.pulse is not None and channel is not None:
        return find_second_push(recording.channel(channel), prepared.pulse, sample_rate=rate, seconds=seconds)
    after = find_second_impact(sound, 0, sample_rate=rate, seconds=seconds)
    return None if after is None else begin + after


def prepare_single(recording: Recording, settings: CaptureSettings) -> tuple[Prepared, int | None]:
    """Prepare a recording of one impact; of more, up to the second, whose sample in the file is returned as well.

    Raises `CaptureError` as `prepare`, and for a hum or noise (`check_impulsive`).
    """
    prepared = prepare(recording, settings)
    # Of one channel all is used, the silence before the impact too.
    alone = len(recording.channels) == 1
    samples = remove_rumble(recording.response(), settings.highpass, recording) if alone else prepared.sound
    check_impulsive(samples, sample_rate=recording.sample_rate, name=recording.name)
    begin = prepared.onset if settings.align else 0
    second = _second_impact(prepared.sound, begin, recording, prepared, settings.force_channel)
    if second is not None:
        length = max(second - begin, shortest_allowed(recording.sample_rate))
        prepared = replace(prepared, sound=prepared.sound[:length])
    return prepared, second


def noise_level(response: Float64[np.ndarray, " frames"], onset: int, rate: float) -> float:
    """Return the noise's root mean square: before the impact, or of the quietest tenth of 10 ms blocks."""
    before = response[: max(0, onset - round(SECONDS_BEFORE * rate))]
    size = max(64, round(0.01 * rate))
    if len(before) >= size:
        return float(np.std(before))
    size = min(size, len(response))
    blocks = response[: len(response) // size * size].reshape(-1, size)
    return float(np.quantile(np.std(blocks, axis=1), 0.1))


def decibels(ratio: float) -> float:
    """Return the level of an amplitude ratio; silence is 200 dB down, so that it stays a number."""
    return float(20 * np.log10(max(ratio, 1e-10)))


def check_impulsive(sound: Float64[np.ndarray, " samples"], *, sample_rate: float, name: str) -> None:
    """Raise `CaptureError` for a sound that neither rises nor falls: a hum, or noise.

    Sounds shorter than 80 ms are too short to tell.
    """
    size = max(64, math.ceil(0.01 * sample_rate))
    if len(sound) < 8 * size:
        return
    frames = sound[: len(sound) // size * size].reshape(-1, size)
    levels = np.sqrt(np.mean((frames - frames.mean(axis=1, keepdims=True)) ** 2, axis=1))
    loudest, quietest = float(levels.max()), float(np.quantile(levels, 0.1))
    if loudest < _MIN_RISE * quietest:
        level = 20 * math.log10(loudest / quietest)
        wanted, advice = (
            "its loudest 10 ms at least 6 dB above its quietest",
            "record one impact with silence around it",
        )
        raise CaptureError.expected(wanted, level, got=f"{level:.1f} dB", file=name, advice=advice)


def find_clipping(response: Float64[np.ndarray, " frames"], *, name: str) -> str | None:
    """Return a message on how much of a channel, with its offset, is clipped; None where nothing is."""
    clipped = clipped_samples(response)
    found = f"{name}: {clipped} samples ({clipped / len(response):.2%}) are clipped at {np.abs(response).max():.3g}"
    return f"{found}, which no mode can explain; turn the gain down and record it again" if clipped else None
