"""Settings that would help to read a capture folder, found from its content, and the `capture.toml` that says so.

A setting is proposed only where data show that it helps: the recordings, or for units the contacts and the surface.
docs/decisions/reading-recordings.md has the measurements behind the limits.
"""

import json
import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.text import read_toml
from avmsf.capture.audio import Recording
from avmsf.capture.checks import NARROWEST, WIDEST, find_surface, fitting_units_of
from avmsf.capture.folder import read_recordings
from avmsf.capture.issues import Issues
from avmsf.capture.measure import HIGHEST_NOISE_DB, decibels, noise_level
from avmsf.capture.onset import SECONDS_BEFORE, find_onset, find_pulse
from avmsf.capture.placement import check_placement
from avmsf.capture.prepare import prepare, remove_rumble
from avmsf.capture.settings import SETTINGS, CaptureSettings, settings_of
from avmsf.capture.table import Impact, Row, parse_rows, read_rows
from avmsf.errors import AvmsfError, AvmsfWarning, CaptureError
from avmsf.mesh.surface import surface_points


@dataclass(frozen=True)
class _Tolerances:
    """From where on the recordings show that a setting helps."""

    push_share: float = 0.5  # of a hammer's energy within its push and a width on either side: .92; accelerometers' .24
    cutoffs_hz: tuple[float, float] = (20.0, 40.0)  # the lower limit of hearing, and an octave above
    fall: float = 10**0.6  # 6 dB: of the noise's power by a highpass; a few periods of noise scatter by 3 below it
    noise_share: float = 1e-6  # -60 dB: mean square of noise over the squared peak that hides a decay over its T60
    audio_rate_hz: float = 16_000.0  # slower recordings are of structures that vibrate below 20 Hz
    low_share: float = 0.1  # of the energy after the impacts below the lowest cutoff: no sound of the object
    lead_seconds: float = 0.1  # two periods of the lowest cutoff: less before an impact does not show rumble


_TOLERANCES = _Tolerances()
_HEADING = """\
# Proposed by `avmsf check --write-settings` from the folder's files; change or remove what does not suit.
"""


@dataclass(frozen=True)
class Proposal:
    """One setting whose proposed value would help: plain values, so that `dataclasses.asdict` gives what JSON holds."""

    key: str
    """A field of `CaptureSettings`."""
    value: Any
    """What TOML can hold: true or false, a number or text."""
    reason: str

    @property
    def line(self) -> str:
        """The setting as a line of TOML."""
        return f"{self.key} = {json.dumps(self.value)}"


def propose_settings(folder: str | Path, wrong: Sequence[AvmsfError | AvmsfWarning] = ()) -> tuple[Proposal, ...]:
    """Return the settings other than the present ones that would help to read a folder, with the reasons.

    A key that the folder's `capture.toml` holds was chosen and is left alone. Recordings that cannot be read are passed
    over; raises nothing for bad input. Of what else was found `wrong`, units have those that mend them as their value.
    """
    folder, found = Path(folder), list[Proposal]()
    try:
        chosen = set(read_toml(folder / SETTINGS)) if (folder / SETTINGS).is_file() else set()
        settings, rows = settings_of(folder), read_rows(folder)[0]
    except (CaptureError, OSError, ValueError):
        return ()
    for keys, propose in (
        ({"unit", "surface_unit"}, _units),
        ({"force_channel", "response_channel"}, _channels),
        ({"highpass"}, _highpass),
    ):
        if not chosen & keys:
            found += propose(folder, rows, replace(settings, **{each.key: each.value for each in found}))
    for each in wrong:
        mends = each.name in ("unit", "surface_unit") and each.value and not each.value.keys() & chosen
        if mends and not any(proposal.key.endswith("unit") for proposal in found):
            reason = "The contacts, the object and the photographs' cameras then count one unit."
            found += [Proposal(key, unit, reason) for key, unit in each.value.items()]
    return tuple(found)


def write_settings(folder: str | Path, proposals: Sequence[Proposal]) -> Path:
    """Write the proposals with their reasons as the folder's `capture.toml` and return its path.

    Raises `CaptureError`, and changes nothing, where the folder has one already or it cannot be written.
    """
    path, parts = Path(folder) / SETTINGS, [_HEADING]
    for each in proposals:
        reason = textwrap.wrap(each.reason, 100, initial_indent="# ", subsequent_indent="# ")
        parts.append("\n".join([*reason, each.line, ""]))
    if os.path.lexists(path):
        advice = f"add to it by hand: {'; '.join(each.line for each in proposals)}"
        raise CaptureError.expected("no such file", got="an existing one", file=path, advice=advice)
    write_whole(path, "\n".join(parts), raising=CaptureError)
    return path


def contacts_of(impacts: Sequence[Impact]) -> Float64[Tensor, "contacts 3"]:
    """Return the contacts of impacts, meters, float64."""
    return torch.tensor([each.contact for each in impacts], dtype=torch.float64).reshape(-1, 3)


def _units(folder: Path, rows: Sequence[Row], settings: CaptureSettings) -> list[Proposal]:
    """Return the units in which contacts lie on the object, where the present ones cannot be meant."""
    placement, contacts = None, contacts_of(parse_rows(rows, settings, Issues(collect=True)))
    with suppress(CaptureError):
        surface = find_surface(folder, settings)
        placement = None if surface is None else check_placement(contacts, surface_points(surface))
    if placement is None:
        return []
    if placement.fault != "unit" and NARROWEST <= placement.diagonal <= WIDEST:
        return []
    units: dict[str, Any] = fitting_units_of(placement, settings)
    size = placement.diagonal / settings.surface_meters * replace(settings, **units).surface_meters
    reason = (
        f"The contacts then lie on the surface, {size:.3g} m across. In the present units the contacts are "
        f"{placement.spread:.3g} m across and the surface {placement.diagonal:.3g} m."
    )
    return [Proposal(key, unit, reason) for key, unit in units.items()]


def _channels(folder: Path, rows: Sequence[Row], settings: CaptureSettings) -> list[Proposal]:
    """Return which channel is the hammer's and which the sound's.

    A hammer's channel holds one short push in every recording. Of several sounds beside it, the one that stands highest
    above its noise; without a hammer only where the others hold no clear impact (`HIGHEST_NOISE_DB`), for a
    channel of several pushes is no sound.
    """
    figures = []
    for _, recording in _recordings(folder, rows, settings):
        figures.append([_push_and_level(each, recording.sample_rate) for each in recording.channels])
        if not 1 < len(figures[-1]) == len(figures[0]):
            return []
    if not figures:
        return []
    shares, above = np.array(figures).transpose(2, 0, 1)
    proposals, sounds = [], list(range(shares.shape[1]))
    hammers = np.flatnonzero(shares.min(axis=0) >= _TOLERANCES.push_share)
    if len(hammers) == 1:
        hammer = int(hammers[0])
        sounds.remove(hammer)
        reason = (
            f"Channel {hammer + 1} is a hammer's: in every recording one short pulse holds at least "
            f"{shares[:, hammer].min():.0%} of its energy, in the others at most {shares[:, sounds].max():.0%}. "
            "Where it is not in newtons, write force_scale as well."
        )
        proposals.append(Proposal("force_channel", hammer + 1, reason))
    levels = np.median(above, axis=0)[sounds]
    best = int(np.argmax(levels))
    if len(sounds) > 1 and (proposals or (np.delete(levels, best) < -HIGHEST_NOISE_DB).all()):
        shown = ", ".join(f"{row + 1}: {level:.0f} dB" for row, level in zip(sounds, levels, strict=True))
        reason = (
            f"Of the channels that can be the sound, {sounds[best] + 1} has the highest level above its noise "
            f"({shown}). Another one can be chosen."
        )
        proposals.append(Proposal("response_channel", sounds[best] + 1, reason))
    return proposals


def _push_and_level(channel: Float64[np.ndarray, " frames"], rate: float) -> tuple[float, float]:
    """Return the share of a channel's energy within its first push, and its peak over its noise, dB; 0 for silence."""
    if np.ptp(channel) == 0:
        return 0.0, 0.0
    pulse = find_pulse(channel)
    power, width = np.square(channel - pulse.rest), pulse.stop - pulse.start
    share = float(power[max(0, pulse.start - width) : pulse.stop + width].sum() / power.sum())
    noise = noise_level(channel, find_onset(channel, sample_rate=rate), rate)
    return share, -decibels(noise / float(np.sqrt(power.max())))


def _highpass(folder: Path, rows: Sequence[Row], settings: CaptureSettings) -> list[Proposal]:
    """Return the lowest cutoff that removes most of the noise and nothing of the object's."""
    lowest, rates, durations, noise, low = _TOLERANCES.cutoffs_hz[0], set(), [], [], []
    for impact, recording in _recordings(folder, rows, settings):
        with suppress(CaptureError):
            rate, prepared = recording.sample_rate, prepare(recording, settings, newtons=impact.newtons)
            response = recording.response(settings.response_channel, force_channel=settings.force_channel)
            onset, response = prepared.onset, response / float(np.abs(response).max())
            if prepared.pulse is None and recording.duration * lowest >= 1.0:
                # Sway and drift as loud as the impact hide its onset.
                onset = find_onset(remove_rumble(response, lowest, recording), sample_rate=rate)
            lead = response[: max(0, onset - round(SECONDS_BEFORE * rate))]
            later = _powers_below(response[onset : onset + round(settings.kept_seconds(rate) * rate)], rate)
            rates.add(rate)
            durations.append(recording.duration)
            noise += [(_powers_below(lead, rate), later)] if len(lead) >= _TOLERANCES.lead_seconds * rate else []
            # Digital silence, as after a click at the start, has no rumble.
            low.append(later[0] / later[-1] if later[-1] else 0.0)
    if len(rates) != 1 or len(durations) < 2:
        return []
    if min(rates) >= _TOLERANCES.audio_rate_hz and (share := float(np.median(low))) > _TOLERANCES.low_share:
        reason = (
            f"{share:.0%} of the energy after the impacts lies below {lowest:g} Hz: drift, sway or a sensor that "
            "settles. Leave it out if the object itself vibrates there."
        )
        return [Proposal("highpass", lowest, reason)]
    if len(noise) < len(durations) / 2:
        return []
    (*below, total), (*after, _) = np.mean(noise, axis=0)
    left, chosen = total, None
    for cutoff, lower, later_lower in zip(_TOLERANCES.cutoffs_hz, below, after, strict=True):
        rest = max(total - lower, 1e-12 * total)
        silent = later_lower <= _TOLERANCES.fall * lower
        if cutoff * min(durations) >= 1.0 and silent and left / rest >= _TOLERANCES.fall:
            chosen, left = cutoff, rest
    if chosen is None or total < _TOLERANCES.noise_share:
        return []
    reason = (
        f"Before the impacts, an offset or rumble below {chosen:g} Hz is most of the noise: without it, noise is "
        f"{10 * np.log10(total / left):.0f} dB lower. The object does not vibrate there: the power below "
        f"{chosen:g} Hz does not rise at the impact."
    )
    return [Proposal("highpass", chosen, reason)]


def _recordings(folder: Path, rows: Sequence[Row], settings: CaptureSettings) -> Iterator[tuple[Impact, Recording]]:
    """Yield what can be read of a folder."""
    issues = Issues(collect=True)
    yield from read_recordings(folder, parse_rows(rows, settings, issues), issues)


def _powers_below(signal: Float64[np.ndarray, " samples"], rate: float) -> Float64[np.ndarray, " limits"]:
    """Return the mean squares of what lies below each of the cutoffs, and of all."""
    power = np.abs(np.fft.rfft(signal) / len(signal)) ** 2
    power[1 : (len(signal) + 1) // 2] *= 2.0
    frequency = np.fft.rfftfreq(len(signal), 1.0 / rate)
    return np.array([power[frequency < limit].sum() for limit in (*_TOLERANCES.cutoffs_hz, np.inf)])
