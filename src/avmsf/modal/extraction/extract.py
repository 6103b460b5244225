"""Modes, gains and residual from recordings, and a file that keeps them.

Linear algebra rounds differently from one run to the next, so modes that are found again differ in their last digits;
work that goes on after an interruption needs the very ones it began with.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf._utils.caching import content_digest, keep_if_possible, source_digest
from avmsf._utils.headers import FileKind
from avmsf._utils.tensor_files import TensorReader, read_tensors, write_tensors
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.errors import ExtractionError, FieldFileError
from avmsf.modal.config import ExtractionMethod
from avmsf.modal.extraction.alignment import Alignment, align, recording_keys
from avmsf.modal.extraction.esprit import SHORTEST
from avmsf.modal.extraction.finders import HighResolution, ModeFinder, lowest_frequency
from avmsf.modal.extraction.frequency_shifts import FrequencyShifts, modal_sounds
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import Residual, estimate_residual, noise_bins

FINDERS: dict[ExtractionMethod, type[ModeFinder]] = {"high-resolution": HighResolution, "short-time": ShortTime}
"""By the names that `avmsf modes --extraction` and `PipelineConfig.extraction` take."""
_KIND = FileKind("avmsf-modes", "modes", "find them again", FieldFileError)
_ALIGNMENT = "alignment."


@dataclass(frozen=True, eq=False)
class Extraction:
    """Modes shared by all recordings, their gains in each, and the residual noise."""

    __repr__ = short_repr

    bank: ModalBank
    gains: Complex[Tensor, "contacts modes"]
    """The mode is Im(c exp((-d + 2 pi i f) t)) in a recording of gain c, in the recordings' own unit: the real part is
    what starts as a sine, the imaginary part what starts as a cosine."""
    residual: Residual
    alignment: Alignment | None = None
    """How the recordings were aligned first; None where they were taken as they are."""
    shifts: FrequencyShifts | None = None
    """The poles that each recording has of its own, which its gains are of; None where all have those of `bank`."""

    def take(self, rows: Sequence[int]) -> "Extraction":
        """Return the gains of some of the recordings, with the same modes."""
        shifts = None if self.shifts is None else replace(self.shifts, poles=self.shifts.poles[list(rows)])
        return replace(self, gains=self.gains[list(rows)], shifts=shifts)

    def aligned(self, impacts: Impacts) -> Impacts:
        """Return recordings, these or others of the object, with the starts that the gains are of."""
        return impacts if self.alignment is None else self.alignment.apply(impacts)

    def at_common_poles(
        self, sounds: Float[Tensor, "contacts samples"], *, sample_rate: float
    ) -> Float[Tensor, "contacts samples"]:
        """Return the aligned sounds that the gains are of, row for row, without the shifts of their modes' poles."""
        return sounds if self.shifts is None else self.shifts.removed(sounds, self.gains, sample_rate=sample_rate)


def extract_modes(recordings: Capture | Impacts, method: ModeFinder | None = None) -> Extraction:
    """Return the modes that the recordings share, each recording's gains and the residual noise (paper, section 3.4).

    Recordings that are not final (`Impacts.before`) are aligned with one another first.

    Args:
        recordings: A capture, or the impacts of one.
        method: By default `HighResolution()`; `ShortTime()` is the paper's.

    Returns:
        Frequencies, Hz, and dampings, 1/s, [modes]; gains [contacts, modes], the least-squares amplitudes over the
            whole of each sound; the noise.

    Raises:
        ExtractionError: When no mode is found, and for recordings of another type.
    """
    impacts = recordings.impacts if isinstance(recordings, Capture) else recordings
    if not isinstance(impacts, Impacts):
        raise ExtractionError.expected(
            "a Capture or Impacts",
            type(impacts).__name__,
            name="recordings",
            advice="read a folder by avmsf.read(folder)",
        )
    alignment = align(impacts)
    final = impacts if alignment is None else alignment.apply(impacts)
    found = extract_sounds(final.sounds, sample_rate=impacts.sample_rate, method=method)
    return replace(found, alignment=alignment)


def extract_sounds(
    sounds: Float[Tensor, "contacts samples"], *, sample_rate: float, method: ModeFinder | None = None
) -> Extraction:
    """Return what `extract_modes` does, from bare sounds that start at their onset; a single one is enough here.

    Raises ExtractionError for samples that are not finite, and where there is no mode.
    """
    if not bool(torch.isfinite(sounds).all()):
        row = int(torch.nonzero(~torch.isfinite(sounds))[0, 0])
        got, advice = "NaN or infinity", "record or export it again"
        raise ExtractionError.expected("finite samples", got=got, row=row, name="sounds", advice=advice)
    finder = HighResolution() if method is None else method
    bank = finder.find(sounds, sample_rate)
    if len(bank) == 0:
        raise _no_mode(sounds, sample_rate)
    samples = sounds.shape[1]
    shifts = finder.find_shifts(sounds, bank, sample_rate)
    if shifts is None:
        gains = fit_gains(sounds, bank, sample_rate=sample_rate)
        modes = synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=sample_rate)
    else:
        bank, gains = shifts.bank, shifts.gains(sounds, sample_rate=sample_rate)
        modes = modal_sounds(shifts.poles, gains, samples, sample_rate)
    return Extraction(bank, gains, estimate_residual(sounds, modes, bins=noise_bins(samples)), shifts=shifts)


def _no_mode(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ExtractionError:
    """Return the error for sounds without modes: `name` is the property at fault, `value` how large it is."""
    samples, count = sounds.shape[1], len(sounds)
    duration, lowest = samples / sample_rate, lowest_frequency(samples, sample_rate)
    more = "use more seconds after the onset"
    if samples < SHORTEST:
        got = f"{samples} ({duration:.3g} s)"
        return ExtractionError.expected(f"{SHORTEST} samples or more", samples, got=got, name="samples", advice=more)
    moving, tenth = sounds.to(torch.float64) - sounds.mean(1, keepdim=True), samples // 10
    head, tail = (float(part.square().mean()) for part in (moving[:, :tenth], moving[:, -tenth:]))
    fall = 10 * math.log10(max(head, 1e-30) / max(tail, 1e-30))
    power = torch.fft.rfft(moving).abs().square().sum(0)
    below = float(power[: math.ceil(lowest * duration)].sum() / power.sum())
    wanted = f"modes from {lowest:.0f} to {sample_rate / 2:.0f} Hz in {count} recordings of {duration:.3g} s"
    loud = "check the onset and the noise (avmsf check), or record louder impacts"
    for fault, value, got, name, advice in (
        (head + tail == 0, 0.0, f"silence in all {count} recordings", "sounds", "check the channel"),
        (fall < 6, fall, f"noise or hum that decays by {fall:.0f} dB", "decay", loud),
        (below > 0.5, below, f"{100 * below:.0f} % of the energy below {lowest:.0f} Hz", "energy", more),
    ):
        if fault:
            return ExtractionError.expected(wanted, value, got=got, name=name, advice=advice)
    advice = "record at a higher rate, closer, or a less damped object"
    return ExtractionError.expected(wanted, 0, got="none above the noise", name="modes", advice=advice)


def extract_once(train: Impacts, method: ModeFinder, path: Path, *, needed: bool = False) -> Extraction:
    """Return the modes that `path` keeps of these recordings and this method; find and keep them where it has none.

    Where the file cannot be written, the modes are found again next time; it is an error if the file is `needed`.
    Raises as `extract_modes`, and FieldFileError.
    """
    words = [version("avmsf"), source_digest(__name__), repr(method), train.names, train.sample_rate]
    digest = content_digest(words, train.sounds, train.before, train.after)
    kept = _read(path, digest, train)
    if kept is not None:
        return kept
    found = extract_modes(train, method)
    tensors = {
        "frequency": found.bank.frequency,
        "damping": found.bank.damping,
        "gains": torch.view_as_real(found.gains),
        "residual": found.residual.magnitude,
    }
    if found.shifts is not None:
        shift = torch.tensor(found.shifts.relative, dtype=torch.float64)
        tensors |= {"poles": torch.view_as_real(found.shifts.poles), "shift": shift}
    if found.alignment is not None:
        tensors |= {_ALIGNMENT + name: each for name, each in found.alignment.tensors().items()}

    write = partial(write_tensors, path, tensors, digest, _KIND)
    if needed:
        write()
    else:
        keep_if_possible(write, path)
    return found


def _read(path: Path, digest: str, train: Impacts) -> Extraction | None:
    try:
        found, read = read_tensors(path, _KIND)
        if found != digest:
            return None
        bank, shifts = ModalBank(read["frequency"], read["damping"]), None
        if "poles" in read or "shift" in read:
            shifts = FrequencyShifts(bank, torch.view_as_complex(read["poles"].contiguous()), float(read["shift"]))
        alignment, modes = None, read.get(f"{_ALIGNMENT}frequency")
        if modes is not None:
            kept = TensorReader(read, path, _KIND).within(_ALIGNMENT)
            alignment = Alignment.restore(kept, train.names, recording_keys(train), len(modes))
        gains = torch.view_as_complex(read["gains"].contiguous())
        return Extraction(bank, gains, Residual(read["residual"]), alignment, shifts)
    except (FieldFileError, KeyError):
        return None
