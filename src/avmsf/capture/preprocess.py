"""From the recordings of one object to impacts of one rate and length, with a report of what is wrong with them.

Whether files start with their impact, and so are used whole, is decided for all recordings of a capture together. Where
they do not, each is cut at its own onset; `avmsf.modal.extraction.alignment` aligns them with one another later.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from avmsf._utils.text import counted
from avmsf.capture.audio import Recording
from avmsf.capture.impacts import Impacts
from avmsf.capture.issues import Issues
from avmsf.capture.measure import measure
from avmsf.capture.prepare import MIN_MARGIN, Prepared, margin_length, prepare, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Impact
from avmsf.errors import CaptureError, CaptureWarning


@dataclass(frozen=True)
class _Tolerances:
    """What recordings of one capture have in common, and from where on one of them is doubtful."""

    start_level: float = 10**-2.0
    """Share of the largest mean square in the first 20 ms that a response must have at its start: -20 dB. Impulse
    responses reach 0 to -3 dB (aircraft, ruler, tree), those with 4 samples to 1 s before the impact -25 to -47 dB."""
    start_seconds: float = 0.001
    """By when `find_onset` must see every recording that starts with the impact. Where modes cancel at first it takes
    up to .3 ms (a plate of 43 modes at 96 kHz) and 5 samples (the aircraft at 400 Hz)."""
    usual_range_db: float = 80.0  # from the median: near nodes of most modes it is 40, of a soft impact 30
    usual_gap_db: float = 12.0  # of the loudest to the next, of six or more: at most 7 in 24 captures
    range_db: float = 140.0  # of the loudest to the faintest: float32, in which they are fitted, rounds at 144
    equal_peaks: int = 4  # recordings that were scaled to one peak, since struck ones differ by decibels
    same_peak_db: float = 0.05


_TOLERANCES = _Tolerances()


def preprocess(
    recordings: Iterable[tuple[Impact, Recording]],
    settings: CaptureSettings,
    issues: Issues | None = None,
    *,
    measured: bool = True,
) -> tuple[Impacts | None, Issues]:
    """Return the impacts of recordings, their sounds cut to one length from their starts on, and what is wrong.

    The recordings may be read as they are asked for: only what is used stays in memory. Recordings that all start with
    the impact are used whole. Without `align`, or from the peaks on, nothing will be moved later, so that `before` and
    `after` are None. Computed sounds, not `measured`, are not searched for clipping, noise and second impacts. Issues
    are added to those given. Raises `CaptureError` as `prepare`, and where sample rates differ or the settings ask for
    too little, unless `issues` collect; then the impacts are None where none can be made.
    """
    issues = Issues() if issues is None else issues
    used = []
    for impact, recording in recordings:
        with issues.keep((impact.file, impact.line)):
            prepared = prepare(recording, settings, newtons=impact.newtons)
            if measured:
                issues.reports.append(measure(recording, prepared, settings=settings, line=impact.line))
            peak = float(np.abs(prepared.sound).max())
            issues.sounds[impact.file] = hashlib.sha256(prepared.sound.data).digest(), peak
            used.append((impact, _shorten(prepared, settings, gain=10 ** (-impact.gain_db / 20))))
    if used:
        with issues.keep():
            return _join(*zip(*used, strict=True), settings=settings, issues=issues), issues
    return None, issues


def _shorten(prepared: Prepared, settings: CaptureSettings, *, gain: float) -> Prepared:
    """Return a recording times a gain in float32, with no more of it than can be used, so that many fit in memory."""
    most = round(settings.kept_seconds(prepared.rate) * prepared.rate) + margin_length(prepared.rate)
    sound, before = ((gain * part).astype(np.float32) for part in (prepared.sound[:most], prepared.before))
    return replace(prepared, sound=sound, before=before)


def _join(
    impacts: Sequence[Impact], sounds: Sequence[Prepared], *, settings: CaptureSettings, issues: Issues
) -> Impacts:
    names = [each.file for each in impacts]
    rate = common_rate([each.rate for each in sounds], names)
    movable = settings.align and not settings.from_peaks
    issues.uncut = movable and settings.force_channel is None and start_with_impact(sounds)
    if issues.uncut:
        wholes = [np.concatenate([each.before, each.sound]) for each in sounds]
        sounds = [replace(each, sound=whole, before=whole[:0]) for each, whole in zip(sounds, wholes, strict=True)]
    length = _common_length([len(each.sound) for each in sounds], names, rate=rate, settings=settings, issues=issues)
    before = after = None
    if movable:
        size = margin_length(rate)
        before = torch.full((len(sounds), size), torch.nan)
        after = before.clone()
        for row, each in enumerate(sounds):
            rest = each.sound[length : length + size]
            before[row, size - len(each.before) :] = torch.from_numpy(each.before)
            after[row, : len(rest)] = torch.from_numpy(rest)
    forces, directions = [each.newtons for each in sounds], [each.direction for each in impacts]
    known = all(each is not None for each in directions)
    return Impacts(
        contacts=torch.from_numpy(np.array([each.contact for each in impacts], dtype=np.float64)),
        sounds=torch.from_numpy(np.stack([each.sound[:length] for each in sounds])),
        sample_rate=rate * settings.playback_speed,
        names=tuple(names),
        directions=torch.from_numpy(np.array(directions, dtype=np.float32)) if known else None,
        forces=None if None in forces else torch.tensor(forces, dtype=torch.float32),
        before=before,
        after=after,
    )


def latest_start(rate: float) -> int:
    """Return the sample before which an onset is found in a recording that starts with its impact, at a rate in Hz."""
    return max(MIN_MARGIN, round(_TOLERANCES.start_seconds * rate))


def start_with_impact(recordings: Sequence[Prepared]) -> bool:
    """Return whether all recordings start with the impact, without anything before it, as impulse responses do.

    In a single recording modes may cancel at first; over all of them they do nowhere. So the mean square of sounds of
    equal energy is within a sixteenth of a period (of the root mean square frequency), or two samples, nearly as large
    as later: a sine reaches -8 dB by then, and what comes before an impact is noise. Every single onset has to come
    before `latest_start` as well.
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
    return bool(mean[:first].max() >= _TOLERANCES.start_level * mean.max())


def common_rate(rates: Sequence[float], names: Sequence[str]) -> float:
    """Return the one sample rate of the files, Hz; `CaptureError` where they differ."""
    counts = Counter(rates).most_common()
    if len(counts) > 1:
        first = {rate: names[list(rates).index(rate)] for rate, _ in counts}
        got = ", ".join(f"{rate:g} Hz ({counted(count, 'file')}, {first[rate]} the first)" for rate, count in counts)
        wanted, advice = "recordings of one sample rate", "nothing is resampled, so convert them to one rate"
        raise CaptureError.expected(wanted, list(first), got=got, name="sample_rate", advice=advice)
    return rates[0]


def _common_length(
    lengths: Sequence[int], names: Sequence[str], *, rate: float, settings: CaptureSettings, issues: Issues
) -> int:
    """Return the length of all sounds in samples: `kept_seconds`, or all of the shortest; warn where one cuts all."""
    seconds = settings.kept_seconds(rate)
    asked, least, shortest = round(seconds * rate), shortest_allowed(rate), min(lengths)
    if asked < least:
        wanted, got = f"at least {least} samples at {rate:g} Hz", f"{asked} ({seconds:g} s)"
        raise CaptureError.expected(wanted, seconds, got=got, name="seconds", advice="increase it in capture.toml")
    usual = min(asked, int(np.median(lengths)))
    if shortest < 0.9 * usual:
        name = names[list(lengths).index(shortest)]
        message = (
            f"{name}: {shortest / rate:.3g} s after its onset, most recordings have {usual / rate:.3g} s; all sounds "
            "are cut to this length; record it again or remove its row"
        )
        issues.warnings.append(CaptureWarning(message, file=name, value=shortest / rate))
    return min(asked, shortest)


def check_levels(sounds: dict[str, tuple[bytes, float]]) -> list[CaptureWarning]:
    """Return a warning where one of `Issues.sounds` is far louder or fainter than the others, or all peaks are one.

    Raises `CaptureError` where the loudest and the faintest differ by more than float32 holds.
    """
    if not sounds:
        return []
    names, peaks = list(sounds), [peak for _, peak in sounds.values()]
    levels = 20 * np.log10(peaks)
    away, extent = levels - np.median(levels), float(np.ptp(levels))
    row, most = int(np.abs(away).argmax()), _TOLERANCES.range_db
    found = f"{away[row]:+.0f} dB from that of most recordings ({np.median(peaks):.3g})"
    if extent > most:
        wanted = f"at most {most:g} dB between the loudest and the faintest"
        got, advice = f"{extent:.0f}; its peak, {peaks[row]:.3g}, is {found}", "export it at the scale of the others"
        raise CaptureError.expected(wanted, peaks[row], got=got, file=names[row], name="peak", advice=advice)
    if len(levels) >= _TOLERANCES.equal_peaks and extent < _TOLERANCES.same_peak_db:
        message = (
            f"all {len(levels)} recordings have the same peak, {peaks[0]:.3g}: expected the levels as recorded, got "
            "each scaled to one peak, which loses how strong the modes are at each contact; export them unscaled"
        )
        return [CaptureWarning(message, file=names[0], name="peak", value=peaks[0])]
    wanted, advice = f"at most {_TOLERANCES.usual_range_db:g} dB", "check its gain, its scale and its force"
    next_loudest, loudest = np.argsort(levels, kind="stable")[-2:] if len(levels) >= 6 else (row, row)
    if (gap := levels[loudest] - levels[next_loudest]) > _TOLERANCES.usual_gap_db:
        row, wanted = int(loudest), f"at most {_TOLERANCES.usual_gap_db:g} dB"
        found = f"{gap:.0f} dB above that of the next loudest recording"
    elif abs(away[row]) <= _TOLERANCES.usual_range_db:
        return []
    message = f"{names[row]}: its peak, {peaks[row]:.3g}, is {found}; expected {wanted}; {advice}"
    return [CaptureWarning(message, file=names[row], name="peak", value=peaks[row])]
