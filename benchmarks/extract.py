"""Whether the modes that are there are found, and how much of real sounds they explain."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.capture import Impacts
from avmsf.errors import ExtractionError
from avmsf.evaluation.metrics import relative_stft_error
from avmsf.evaluation.simple_methods import floor
from avmsf.modal.extraction.extract import extract_modes, extract_sounds
from avmsf.modal.extraction.finders import HighResolution, ModeFinder, ShortTime
from avmsf.modal.modes import ModalBank
from benchmarks.material import IMPULSE, clips_in_place
from benchmarks.report import Options, Report, Table, log
from tests.oracles.plate import PlateModes, plate_modes

METHODS: dict[str, ModeFinder] = {"pencil": HighResolution(), "stft": ShortTime()}
NOISES = (20, 40, 60)
"""How far the noise lies below the sounds, decibels."""
STRONG_DB = 40.0
"""Modes within this of the strongest have to be found, decibels of energy."""
NEAR = 0.005
"""Part of its frequency by which a mode may be off and still be taken for it."""
DOUBLET = (1681.0, 1684.0)
"""Where the bowl's doublet was seen, Hz."""
CONVENTIONS = (
    "pencil: HighResolution, the default; stft: ShortTime, the paper's method.",
    "recall: part of the modes within 40 dB of the strongest (gain^2 / 4d summed over contacts) that were found. A "
    "found and a true mode are matched where each is the other's nearest and they differ by less than .5 %.",
    "spurious: part of the found modes that match none. frequency_error, damping_error: relative, worst of all matched "
    "modes; beside it their median.",
    "Clips' error: relative STFT error (FFT 2048/1024/512/256, hop a quarter) of the least-squares fit of the modes, in"
    " phase and in quadrature; each clip relative to itself, mean over clips. No mode found counts as silence, 1.",
)


@dataclass(frozen=True, eq=False)
class Match:
    """Found modes beside true ones."""

    recall: float
    spurious: float
    frequency_error: Float[Tensor, " matched"]
    """Relative."""
    damping_error: Float[Tensor, " matched"]
    """Relative."""

    @classmethod
    def of(cls, found: ModalBank, truth: PlateModes) -> "Match":
        """Match the modes of a plate with those that were found in its sounds."""
        distance = (found.frequency[:, None] - truth.frequency[None, :]).abs()
        nearest = distance.argmin(1)
        rows = torch.arange(len(found))
        mutual = (distance.argmin(0)[nearest] == rows) & (distance[rows, nearest] < NEAR * truth.frequency[nearest])
        rows, partners = rows[mutual], nearest[mutual]
        energy = (truth.gains.square() / (4 * truth.damping)).sum(0)
        strong = energy >= energy.max() * 10 ** (-STRONG_DB / 10)
        matched = torch.zeros_like(strong)
        matched[partners] = True
        return cls(
            float((matched & strong).sum() / strong.sum()),
            1.0 - len(rows) / len(found),
            (found.frequency[rows] / truth.frequency[partners] - 1).abs(),
            (found.damping[rows] / truth.damping[partners] - 1).abs(),
        )

    def figures(self) -> dict[str, float]:
        """Return the figures by name; errors are NaN where nothing matched."""
        errors = {"frequency_error": self.frequency_error, "damping_error": self.damping_error}
        figures = {"recall": self.recall, "spurious": self.spurious}
        for name, values in errors.items():
            figures[name] = float(values.max()) if len(values) else math.nan
            figures[f"{name}_median"] = float(values.median()) if len(values) else math.nan
        return figures


def measure(options: Options) -> Report:
    """Return how well modes are found on the chosen parts."""
    report = Report(CONVENTIONS)
    for part in options.parts:
        report += PARTS[part](options)
    return report


def _plate(options: Options) -> Report:
    count, seconds = (5, 1.0) if options.quick_look else (20, 3.0)
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    names: list[str] = []
    for noise in NOISES:
        strikes = IMPULSE.strikes(count, seconds=seconds, noise_db=-noise)
        truth = plate_modes(IMPULSE.plate, strikes.contacts)
        for method, finder in METHODS.items():
            found = extract_modes(strikes, finder).bank
            log(f"plate, noise {noise} dB down, {method}: {len(found)} modes for {len(truth.frequency)}")
            each = Match.of(found, truth).figures() | {"modes": float(len(found))}
            names = list(each)
            rows.append([f"{method}, {noise} dB", *each.values()])
            prefix = "plate." if method == "pencil" else f"plate.{method}."
            figures |= {f"{prefix}noise{noise}.{name}": value for name, value in each.items()}
            if noise == 40:
                figures |= {f"{prefix}{name}": value for name, value in each.items()}
    title = (
        f"plate: {len(truth.frequency)} modes from 0 to 8 kHz, ideal impulse, {count} recordings of {seconds:g} s at "
        "44.1 kHz, noise so far down rms"
    )
    return Report(tables=(Table(title, ("method, noise", *names), rows),), figures=figures)


def _bowl_clips(options: Options) -> Report:
    """Judge the clips as recorded, and without the rumble below 20 Hz that holds half their energy and nobody hears."""
    return _bowl(options, "bowl_clips", 0.0) + _bowl(options, "bowl_clips.audible", 20.0)


def _bowl(options: Options, key: str, highpass: float) -> Report:
    clips = clips_in_place("bowl_clips", highpass=highpass)
    length = min(len(clip.sound) for clip in clips)
    sounds = torch.stack([clip.sound[:length] for clip in clips])
    rate = clips[0].sample_rate
    left_out = range(2 if options.quick_look else len(clips))
    figures: dict[str, float] = {}
    errors: dict[str, list[float]] = {}
    for method, finder in METHODS.items():
        errors[method] = []
        for row in left_out:
            others = torch.cat([sounds[:row], sounds[row + 1 :]])
            bank = _modes_of(others, rate, finder)
            errors[method].append(1.0 if bank is None else _error(sounds[row], bank, rate))
            log(f"{key} without {clips[row].name}, {method}: {len(bank or ())} modes, error {errors[method][-1]:.3f}")
        figures[f"{key}.error_{method}"] = sum(errors[method]) / len(errors[method])
    bank = extract_sounds(sounds, sample_rate=rate, method=METHODS["pencil"]).bank
    low, high = (float(bank.frequency[(bank.frequency - place).abs().argmin()]) for place in DOUBLET)
    figures |= {f"{key}.doublet_low_hertz": low, f"{key}.doublet_high_hertz": high}
    figures |= {f"{key}.doublet_separation_hertz": high - low, f"{key}.modes_pencil": float(len(bank))}
    rows: list[list[str | float]] = [
        [clips[row].name, *(errors[method][place] for method in METHODS)] for place, row in enumerate(left_out)
    ]
    rows.append(["mean", *(figures[f"{key}.error_{method}"] for method in METHODS)])
    title = (
        f"{key}: {f'above {highpass:g} Hz' if highpass else 'as recorded'}; modes from {len(clips) - 1} clips, error "
        f"on the one left out, {length / rate:g} s, {rate:g} Hz; of all clips' {len(bank)} modes by pencil the nearest "
        f"to 1681 and 1684 Hz: {low:.2f} and {high:.2f} Hz"
    )
    return Report(tables=(Table(title, ("left out", *METHODS), rows),), figures=figures)


def _hammer_clips(options: Options) -> Report:
    return _own_modes("hammer_clips", options)


def _realimpact_clips(options: Options) -> Report:
    return _own_modes("realimpact_clips", options)


PARTS: dict[str, Callable[[Options], Report]] = {
    "plate": _plate,
    "bowl_clips": _bowl_clips,
    "hammer_clips": _hammer_clips,
    "realimpact_clips": _realimpact_clips,
}


def _own_modes(key: str, options: Options) -> Report:
    """Return how much of each clip its own modes explain, and how many they are."""
    clips = clips_in_place(key)[: 1 if options.quick_look else None]
    rows: list[list[str | float]] = []
    figures: dict[str, float] = {}
    for clip in clips:
        row: list[str | float] = [clip.name, len(clip.sound) / clip.sample_rate]
        for method, finder in METHODS.items():
            bank = _modes_of(clip.sound[None], clip.sample_rate, finder)
            error = 1.0 if bank is None else _error(clip.sound, bank, clip.sample_rate)
            modes = 0 if bank is None else len(bank)
            figures |= {f"{key}.{clip.name}.error_{method}": error, f"{key}.{clip.name}.modes_{method}": float(modes)}
            row += [error, modes]
        log(f"{key}, {clip.name}: {row[2:]}")
        rows.append(row)
    for method in METHODS:
        each = [figures[f"{key}.{clip.name}.error_{method}"] for clip in clips]
        figures[f"{key}.error_{method}"] = sum(each) / len(each)
    rows.append(["mean", math.nan, figures[f"{key}.error_pencil"], "", figures[f"{key}.error_stft"], ""])
    columns = ("clip", "seconds", "error, pencil", "modes, pencil", "error, stft", "modes, stft")
    return Report(tables=(Table(f"{key}: each clip by its own modes", columns, rows),), figures=figures)


def _modes_of(sounds: Float[Tensor, "contacts samples"], sample_rate: float, finder: ModeFinder) -> ModalBank | None:
    try:
        return extract_sounds(sounds, sample_rate=sample_rate, method=finder).bank
    except ExtractionError as error:
        log(str(error))
        return None


def _error(sound: Float[Tensor, " samples"], bank: ModalBank, sample_rate: float) -> float:
    """Return the relative STFT error of one sound's best fit by the modes."""
    alone = Impacts(torch.zeros(1, 3), sound[None], sample_rate, ("clip",))
    fitted = floor(alone, bank)
    return float(relative_stft_error(fitted, sound[None], sample_rate=sample_rate)[0])
