"""Whether the modes that are there are found, and how much of real sounds they explain."""

import math
from collections.abc import Iterator
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.errors import ExtractionError
from avmsf.evaluation.metrics import relative_stft_error
from avmsf.evaluation.modal_metrics import truth_at
from avmsf.evaluation.simple_methods import floor
from avmsf.evaluation.splits import split
from avmsf.modal.extraction.extract import extract_modes, extract_sounds
from avmsf.modal.extraction.finders import HighResolution, ModeFinder
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.simulate.recipe import SIM20
from benchmarks.objects import IMPULSE, clips_in_place, simulated
from benchmarks.records import Measurement, Record, Settings, means, records
from tests.oracles.plate import PlateModes, plate_modes

METHODS: dict[str, ModeFinder] = {"pencil": HighResolution(), "stft": ShortTime()}
"""The default, and the paper's method."""
NOISES = (20, 40, 60)
"""How far the noise lies below the sounds, decibels."""
STRONG_DB = 40.0
"""Modes within this of the strongest have to be found, decibels of energy."""
NEAR = 0.005
"""Part of its frequency by which a mode may be off and still be taken for it."""
DOUBLET = (1681.0, 1684.0)
"""Where the bowl's doublet was seen, Hz."""


def _plate(settings: Settings) -> Iterator[Record]:
    """Modes of a plate with 43 modes from 0 to 8 kHz, ideal impulse, 20 recordings of 3 s, noise so far down rms.

    recall: part of the modes within 40 dB of the strongest (gain^2 / 4d summed over contacts) that were found. A found
    and a true mode are matched where each is the other's nearest and they differ by less than .5 %. spurious: part of
    the found modes that match none. frequency_error, damping_error: relative, worst of all matched modes, and median.
    """
    count, seconds = (5, 1.0) if settings.quick else (20, 3.0)
    for noise in NOISES:
        strikes = IMPULSE.strikes(count, seconds=seconds, noise_db=-noise)
        truth = plate_modes(IMPULSE.plate, strikes.contacts)
        for method, finder in METHODS.items():
            found = extract_modes(strikes, finder).bank
            yield from records(_match(found, truth) | {"modes": len(found)}, group=f"{method}.noise{noise}")


def _consensus(settings: Settings) -> Iterator[Record]:
    """Modes of simulated objects by the paper's extraction, of 8 training recordings from onsets and from peaks.

    true: found modes with one of the truth's below half the sample rate within .5 %; false: the others; recall: part of
    the modes within 40 dB of the strongest that were found; error: relative STFT error of the found modes' sines, which
    are fitted to these recordings.
    """
    rows: dict[str, list[dict[str, float]]] = {"onset": [], "peak": []}
    for name in settings.objects or settings.some(tuple(SIM20)):
        capture, truth = simulated(name, settings)
        onsets = split(capture.impacts, 0.2)[0]
        peaks = onsets.delayed(onsets.sounds.abs().argmax(1).double())
        modes = truth_at(truth, onsets.names)
        audible = torch.nonzero(modes.frequency < onsets.sample_rate / 2).flatten()
        frequency, damping, gains = modes.frequency[audible], modes.damping[audible], modes.gains[:, audible].abs()
        expected = PlateModes(frequency, damping, gains)
        for start, impacts in (("onset", onsets), ("peak", peaks)):
            bank = extract_modes(impacts, METHODS["stft"]).bank
            matched = _match(bank, expected)
            false = round(matched["spurious"] * len(bank))
            sounds, rate = impacts.sounds, impacts.sample_rate
            gains = fit_sine_gains(sounds, bank, sample_rate=rate)
            fitted = synthesize(gains, bank.frequency, bank.damping, samples=sounds.shape[1], sample_rate=rate)
            left = relative_stft_error(fitted, sounds, sample_rate=rate)
            rows[start].append(
                {
                    "true": float(len(bank) - false),
                    "false": float(false),
                    "recall": matched["recall"],
                    "error": float(left.mean()),
                }
            )
            yield from records(rows[start][-1], group=start, object=name)
    for start, found in rows.items():
        yield from records(means(found), group=start, object="mean")


def _match(found: ModalBank, truth: PlateModes) -> dict[str, float]:
    """Compare the modes of a plate with those that were found; errors are NaN where nothing matched."""
    distance = (found.frequency[:, None] - truth.frequency[None, :]).abs()
    nearest = distance.argmin(1)
    rows = torch.arange(len(found))
    mutual = (distance.argmin(0)[nearest] == rows) & (distance[rows, nearest] < NEAR * truth.frequency[nearest])
    rows, partners = rows[mutual], nearest[mutual]
    energy = (truth.gains.square() / (4 * truth.damping)).sum(0)
    strong = energy >= energy.max() * 10 ** (-STRONG_DB / 10)
    matched = torch.zeros_like(strong)
    matched[partners] = True
    values = {"recall": float((matched & strong).sum() / strong.sum()), "spurious": 1.0 - len(rows) / len(found)}
    for name in ("frequency", "damping"):
        errors = (getattr(found, name)[rows] / getattr(truth, name)[partners] - 1).abs()
        values[f"{name}_error"] = float(errors.max()) if len(errors) else math.nan
        values[f"{name}_error_median"] = float(errors.median()) if len(errors) else math.nan
    return values


def _bowl(settings: Settings) -> Iterator[Record]:
    """Relative STFT error of each clip of a bowl, fitted with the modes of the others (least squares, sine and cosine).

    As recorded, and above 20 Hz without the inaudible rumble that holds half the energy; no mode found counts as
    silence, 1. doublet: of all clips' modes by pencil the nearest to 1681 and 1684 Hz.
    """
    for key, highpass in (("as recorded", 0.0), ("audible", 20.0)):
        clips = clips_in_place("bowl_clips", highpass=highpass)
        length = min(len(sound) for sound, _ in clips.values())
        sounds, rate = torch.stack([sound[:length] for sound, _ in clips.values()]), next(iter(clips.values()))[1]
        rows = []
        for row, name in enumerate(settings.some(list(clips), 2)):
            others = torch.cat([sounds[:row], sounds[row + 1 :]])
            banks = {method: _modes_of(others, rate, finder) for method, finder in METHODS.items()}
            rows.append({f"error_{method}": _error(sounds[row], bank, rate) for method, bank in banks.items()})
            yield from records(rows[-1], group=key, object=name)
        yield from records(means(rows), group=key, object="mean")
        frequency = extract_sounds(sounds, sample_rate=rate, method=METHODS["pencil"]).bank.frequency
        low, high = (float(frequency[(frequency - each).abs().argmin()]) for each in DOUBLET)
        yield from records({"low_hertz": low, "high_hertz": high, "modes": len(frequency)}, group=f"{key}.doublet")


def _own_modes(settings: Settings, name: str) -> Iterator[Record]:
    """Relative STFT error of each clip, fitted with its own modes; no mode found counts as silence, 1."""
    rows = []
    for clip, (sound, rate) in settings.some(list(clips_in_place(name).items())):
        banks = {method: _modes_of(sound[None], rate, finder) for method, finder in METHODS.items()}
        rows.append({f"error_{method}": _error(sound, bank, rate) for method, bank in banks.items()})
        rows[-1] |= {f"modes_{method}": float(len(bank or ())) for method, bank in banks.items()}
        yield from records(rows[-1], object=clip)
    yield from records(means(rows), object="mean")


def _modes_of(sounds: Float[Tensor, "contacts samples"], sample_rate: float, finder: ModeFinder) -> ModalBank | None:
    try:
        return extract_sounds(sounds, sample_rate=sample_rate, method=finder).bank
    except ExtractionError:
        return None


def _error(sound: Float[Tensor, " samples"], bank: ModalBank | None, sample_rate: float) -> float:
    """Return the relative STFT error of one sound's best fit by the modes."""
    if bank is None:
        return 1.0
    fitted = floor(Impacts(torch.zeros(1, 3), sound[None], sample_rate, ("clip",)), bank)
    return float(relative_stft_error(fitted, sound[None], sample_rate=sample_rate)[0])


PARTS: dict[str, Measurement] = {
    "plate": _plate,
    "consensus": _consensus,
    "bowl_clips": _bowl,
    "hammer_clips": partial(_own_modes, name="hammer_clips"),
    "realimpact_clips": partial(_own_modes, name="realimpact_clips"),
}
