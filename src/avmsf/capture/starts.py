"""Where the sounds of one capture start in their files: decided for all of its recordings together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.capture.prepare import MIN_MARGIN, Prepared, margin_length
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.together import common_length, common_rate
from avmsf.errors import CaptureWarning

START_LEVEL = 10**-2.0
"""Share of the largest mean square in the first 20 ms that a response must have at its start: -20 dB, the
level (a tenth of the peak) from which `find_onset` counts a swing as the impact's. Impulse responses reach 0 to -3 dB
(aircraft, ruler, tree), recordings with 4 samples to 1 s before the impact -25 to -47 dB."""
MAX_START_SECONDS = 0.001
"""By when `find_onset` must see every recording that starts with the impact. Where modes cancel at first it takes up to
.3 ms (a plate of 43 modes at 96 kHz) and 5 samples (the aircraft at 400 Hz); delays of 1 ms are found on alignment."""


def latest_start(rate: float) -> int:
    """Return the sample before which an onset is found in a recording that starts with its impact, at a rate in Hz."""
    return max(MIN_MARGIN, round(MAX_START_SECONDS * rate))


def start_with_impact(recordings: Sequence[Prepared]) -> bool:
    """Return whether all recordings start with the impact, without anything before it, as impulse responses do.

    A single recording does not show this: the first samples of an impulse response are small where its modes happen to
    cancel, and the first is zero where it is a displacement. Over all recordings modes cancel nowhere, so the mean
    square of sounds of equal energy is within a sixteenth of a period (and the first two samples) nearly as large as
    later: a sine reaches -8 dB by then. With anything before the impact it is that of noise. The period is that of the
    root mean square frequency. Every single onset has to come within `MAX_START_SECONDS` or `MIN_MARGIN` samples as
    well.
    """
    rate = recordings[0].rate
    latest = latest_start(rate)
    if any(each.onset >= latest or len(each.before) < each.onset for each in recordings):
        return False
    size = min(margin_length(rate), *(len(each.before) + len(each.sound) for each in recordings))
    starts = np.stack([np.concatenate([each.before, each.sound[:size]])[:size] for each in recordings])
    starts = starts.astype(np.float64)
    power = starts**2
    energies = np.maximum(power.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    mean = (power / energies).mean(axis=0)
    # The squared difference of a sine's samples is its square times (angle between them)^2, on average.
    angle = np.sqrt((np.diff(starts, axis=1) ** 2 / energies).mean() / mean.mean())
    first = max(2, 1 + round(2 * np.pi / 16 / max(float(angle), 1.0 / size)))
    return bool(mean[:first].max() >= START_LEVEL * mean.max())


def are_uncut(recordings: Sequence[Prepared], settings: CaptureSettings) -> bool:
    """Return whether the recordings of a capture are taken from their files' first sample on, though `align` is set.

    A force channel, `align = false` and `time_zero = "peak"` say where the sounds start.
    """
    return (
        settings.align and not settings.from_peaks and settings.force_channel is None and start_with_impact(recordings)
    )


def shorten(prepared: Prepared, settings: CaptureSettings) -> Prepared:
    """Return a recording in float32 with no more of it than `build_impacts` can use, so that many fit in memory."""
    most = round(settings.kept_seconds(prepared.rate) * prepared.rate) + margin_length(prepared.rate)
    sound, before = (part.astype(np.float32) for part in (prepared.sound[:most], prepared.before))
    return replace(prepared, sound=sound, before=before)


def build_impacts(
    recordings: Sequence[Prepared],
    contacts: Float64[Tensor, "contacts 3"],
    *,
    names: Sequence[str],
    settings: CaptureSettings,
    directions: Float[Tensor, "contacts 3"] | None = None,
) -> tuple[Impacts, list[CaptureWarning]]:
    """Return the impacts, their sounds from their starts on cut to one length, and warnings of what shortens them.

    Recordings that all start with the impact (`are_uncut`) are used whole. Without `align`, or from the peaks on,
    nothing will be moved later, so that `before` and `after` are None. Raises `CaptureError` where sample rates differ,
    and as `common_length`.
    """
    rate = common_rate([each.rate for each in recordings], names)
    if are_uncut(recordings, settings):
        recordings = [
            replace(each, sound=np.concatenate([each.before, each.sound]), before=each.before[:0])
            for each in recordings
        ]
    length, remarks = common_length([len(each.sound) for each in recordings], names, rate=rate, settings=settings)
    before = after = None
    if settings.align and not settings.from_peaks:
        size = margin_length(rate)
        before = torch.full((len(recordings), size), torch.nan)
        after = before.clone()
        for row, each in enumerate(recordings):
            rest = each.sound[length : length + size].astype(np.float32)
            before[row, size - len(each.before) :] = torch.from_numpy(each.before.astype(np.float32))
            after[row, : len(rest)] = torch.from_numpy(rest)
    forces = [each.newtons for each in recordings]
    impacts = Impacts(
        contacts=contacts,
        sounds=torch.from_numpy(np.stack([each.sound[:length] for each in recordings]).astype(np.float32)),
        sample_rate=rate * settings.playback_speed,
        names=tuple(names),
        directions=directions,
        forces=None if None in forces else torch.tensor(forces, dtype=torch.float32),
        before=before,
        after=after,
    )
    return impacts, remarks
