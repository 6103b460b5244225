"""Guides towards reference sounds: recordings of another object, or synthetic sounds of a material."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf._utils.caching import content_digest
from avmsf.capture.audio import read_recording
from avmsf.capture.measure import find_clipping, prepare_single
from avmsf.capture.settings import CaptureSettings
from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.errors import AvmsfWarning, CaptureError, EditError
from avmsf.fem.material import Material
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.sound_field import SoundField
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.modes import synthesize
from avmsf.modal.spectra import Sounds, levelled, resampled, with_length

_HELD = 0.9
"""Part of half a recording's rate up to which it still holds all of a sound."""
_FADE = 0.01
"""Seconds over which a reference that ends early hands over to the sound itself."""


@dataclass(frozen=True, eq=False)
class Reference:
    """Target clips: each rendered sound moves towards the clip of the nearest spectrum, at its own level.

    Where a clip ends before the sound, the rest of the sound has no target.
    """

    clips: Float[Tensor, "clips samples"]
    """From their onsets on, padded with silence to the longest."""
    lengths: tuple[int, ...]
    """Samples of each."""
    sample_rate: float
    """Hz, the field's."""
    name: str
    """What reports call it."""

    def __post_init__(self) -> None:
        if not len(self.clips) or len(self.lengths) != len(self.clips):
            raise EditError.expected(f"one for each of {len(self.clips)} clips", len(self.lengths), name="lengths")
        if not bool(torch.isfinite(self.clips).all()):
            row = int(torch.nonzero(~torch.isfinite(self.clips))[0, 0])
            advice = f"record {self.name} again"
            raise EditError.expected("finite samples", got="NaN or inf", row=row, name="clips", advice=advice)
        silent = [row for row, clip in enumerate(self.clips) if float(clip.abs().max()) == 0.0]
        if silent:
            advice = f"omit it from {self.name}"
            raise EditError.expected("sounds", 0.0, got="silence", row=silent[0], name="clips", advice=advice)

    @classmethod
    def of(cls, sounds: Float[Tensor, "clips samples"], *, sample_rate: float, name: str = "reference") -> "Reference":
        """Refer to sounds at the field's rate that start at their onset, all of one length."""
        return cls(sounds.float(), (sounds.shape[1],) * len(sounds), sample_rate, name)

    @classmethod
    def of_material(
        cls, field: SoundField, old: Material, new: Material, *, count: int = 8, seed: Seed = None
    ) -> "Reference":
        """Refer to synthetic impacts on objects of a new material whose modes are distributed like the field's.

        By the laws of linear elasticity frequencies are the field's times sqrt(E'/E r/r'). Those of each sound are
        drawn from their distribution, weighted by gain and stratified; dampings are the new material's, gains scatter
        about the slope of the field's over frequency. Without a `seed` those of the seed 0. Raises `EditError` for
        silent modes, and where all modes lie at half the sample rate or above.
        """
        points = field.gain_field.points
        rows = torch.linspace(0, len(points) - 1, min(len(points), _POINTS)).long()
        size = field.known(points[rows]).power.mean(dim=0).sqrt().double()
        if not (bool(torch.isfinite(size).all()) and bool(size.any())):
            raise EditError.expected("some above 0", float(size.sum()), name="gains", advice="fit the field again")
        frequency = field.bank.frequency * math.sqrt(new.young / old.young * old.density / new.density)
        slope, generator = gain_slope(frequency, size), generator_of(seed)
        order = torch.argsort(frequency)
        reached = torch.cumsum(size[order], dim=0) / size.sum()
        middles = (torch.arange(_QUANTILES, dtype=torch.float64) + 0.5) / _QUANTILES
        log = frequency[order][torch.searchsorted(reached, middles).clamp_max(len(order) - 1)].log()
        lowest = float(log[0].exp())
        if lowest >= 0.5 * field.sample_rate:
            wanted = f"some below half the sample rate of {field.sample_rate:g} Hz"
            raise EditError.expected(wanted, lowest, got=f"{lowest:.4g} Hz and above", name="frequency")
        sounds = [_synthetic(log, slope, new, field, generator) for _ in range(count)]
        return cls.of(torch.cat(sounds), sample_rate=field.sample_rate, name=new.name)

    @classmethod
    def read(cls, paths: str | Path | Sequence[str | Path], *, sample_rate: float) -> "Reference":
        """Read recordings of impacts and resample them to the field's `sample_rate`, Hz; a folder means its wav files.

        Each begins at its onset and ends at a second impact; of several channels the strongest is used. Raises
        `EditError` for a file that is missing, no sound, silent, shorter than 20 ms after the onset, or without an
        onset. Warns of a second impact, of clipping, and of a rate below the field's.
        """
        given = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
        inside = [sorted(path.glob("[!.]*.[wW][aA][vV]")) if path.is_dir() else [path] for path in given]
        found = [path for each in inside for path in each]
        if not found:
            folder, advice = given[0] if given else None, "give a sound file, or a folder with some"
            raise EditError.expected("one or more wav files", file=folder, name="reference", advice=advice)
        clips = [_read_clip(path, sample_rate=sample_rate) for path in found]
        longest = max(len(clip) for clip in clips)
        name = found[0].name if len(found) == 1 else f"{found[0].name} and {len(found) - 1} more"
        padded = torch.cat([with_length(clip[None], longest) for clip in clips])
        return cls(padded, tuple(len(clip) for clip in clips), sample_rate, name)

    def describe(self) -> dict[str, Any]:
        """Return its identifying settings, as plain values."""
        samples = content_digest(self.clips)
        return {"reference": self.name, "lengths": list(self.lengths), "samples_sha256": samples}

    def start(self, rendered: FieldAtContacts) -> ModalEdit:
        """Return the edit by a common pitch and damping, up to 8 and 64 times either way, of least spectral error.

        Modes are sparse: if a mode and its target are a third of an octave apart, the L1 distance of the spectra has no
        gradient. So the pitch comes from optimal transport, which in one dimension is a match of quantiles: a common
        factor on all frequencies moves the quantiles of the spectrum along a logarithmic axis by one step, and the best
        of them is the mean or median difference of two spectra's. A grid over the smoothed spectra's overlap proposes
        one more. The damping is searched on a grid for each proposal, and the loss of the optimization chooses. Only
        the target's own duration counts: beyond its end it continues with the rendered sound, and a longer decay would
        reduce the relative error.
        """
        # Each contact is rendered at every pitch and damping that is tried.
        rendered = rendered.first(6)
        best = (math.inf, 0.0, 0.0)
        for pitch in self._pitches(rendered):
            step, damping = _MAX_LOG_DAMPING / 4, 0.0
            tried: dict[float, float] = {}
            # Nine places over the whole range, then three refinements about the best.
            around = [step * place for place in range(-4, 5)]
            for _ in range(4):
                for each in around:
                    if round(each, 9) not in tried:
                        tried[round(each, 9)] = self._error(rendered, pitch, each)
                damping, step = min(tried, key=lambda each: tried[each]), step / 2
                around = [max(-_MAX_LOG_DAMPING, damping - step), min(_MAX_LOG_DAMPING, damping + step)]
            best = min(best, (tried[damping], pitch, damping))
        return ModalEdit.none(rendered.field.bank, pitch=best[1], damping=best[2])

    def _pitches(self, rendered: FieldAtContacts) -> list[float]:
        """Return proposals of log alpha: that of no change, and those by quantiles and overlap."""
        sounds = rendered.sounds()
        targets, weight = self._nearest(sounds)
        own, aim = (band_spectrum(weight * each).mean(dim=0) for each in (sounds, targets))
        differences = (_quantiles(aim) - _quantiles(own)).clamp(-_MAX_LOG_PITCH, _MAX_LOG_PITCH)
        # Moved by whole bands along the logarithmic axis, spectra overlap more or less.
        most = round(_MAX_LOG_PITCH / math.log(2.0) * _PER_OCTAVE)
        moved = torch.nn.functional.pad(own, (most, most)).unfold(0, len(own), 1).flip(0)
        shift = (int((moved - aim).abs().sum(dim=1).argmin()) - most) * math.log(2.0) / _PER_OCTAVE
        return sorted({0.0, float(differences.mean()), float(differences.median()), shift})

    def _error(self, rendered: FieldAtContacts, pitch: float, damping: float) -> float:
        sounds = rendered.sounds(ModalEdit.none(rendered.field.bank, pitch=pitch, damping=damping))
        if float(sounds.abs().max()) == 0.0:
            return math.inf
        sizes = [scaled_fft_size(size, sample_rate=self.sample_rate) for size in _FFT_SIZES]
        targets, weight = self._nearest(sounds)
        target = spectral_target(weight * targets, fft_sizes=sizes, hops=[size // 4 for size in sizes])
        return float(spectral_loss(weight * sounds, target)) / len(sizes)

    def targets(self, sounds: Sounds, step: int, generator: torch.Generator) -> Sounds:
        """Return the nearest clip of each sound, which goes on as the sound itself where the clip ends."""
        targets, share = self._nearest(sounds)
        return share * targets + (1 - share) * sounds

    def _nearest(self, sounds: Sounds) -> tuple[Sounds, Sounds]:
        """Return the nearest clip of each sound, and its share in the target: 1, and falling to 0 before its end."""
        samples = sounds.shape[1]
        clips = with_length(self.clips, samples).to(sounds)
        distance = torch.cdist(band_spectrum(sounds), band_spectrum(clips), p=1.0)
        chosen = distance.argmin(dim=1)
        targets = levelled(clips[chosen], sounds, sample_rate=self.sample_rate)
        ends = torch.tensor(self.lengths)[chosen, None]
        fade = max(1, round(_FADE * self.sample_rate))
        share = ((ends - torch.arange(samples)) / fade).clamp(0.0, 1.0).to(sounds)
        return targets, torch.where(ends >= samples, torch.ones_like(share), share)


def _read_clip(path: Path, *, sample_rate: float) -> Float[Tensor, " samples"]:
    """Return a recorded impact from its onset to the next, float32 at `sample_rate` Hz, of its strongest channel."""
    try:
        recording = read_recording(path)
        strongest = int(np.argmax(np.var(recording.channels, axis=1)))
        mono = replace(recording, channels=recording.channels[strongest : strongest + 1])
        prepared, second = prepare_single(mono, CaptureSettings())
    except CaptureError as error:
        raise EditError(f"reference {error}", **{**error.attributes, "file": path}) from error
    sound, rate = prepared.sound, mono.sample_rate

    def note(message: str, name: str, value: float | tuple[float, float] | None = None) -> None:
        warnings.warn(AvmsfWarning(message, file=path, name=name, value=value), stacklevel=3)

    clipped = find_clipping(mono.channel(1), name=mono.name)
    if clipped is not None:
        note(clipped, "clipping")
    if second is not None:
        at = (prepared.onset / rate, second / rate)
        found = f"expected one impact, got two at {at[0]:.3f} s and {at[1]:.3f} s; only the first is used"
        note(f"{mono.name}: {found}", "impacts", at)
    if rate < sample_rate:
        lost = f"modes above {_HELD * 0.5 * rate:.4g} Hz are edited towards silence"
        note(f"{mono.name}: expected {sample_rate:g} Hz or more, got {rate:g} Hz; {lost}", "sample_rate", rate)
    clip = torch.from_numpy(np.ascontiguousarray(sound - sound.mean()))[None]
    return resampled(clip, sample_rate=rate, wanted=sample_rate)[0].float()


_QUANTILES = 64
_POINTS = 64
"""Contacts at which a field's gains are taken."""
_MODES = 40
"""Modes of a synthetic sound."""
_MIN_RELATIVE_GAIN = 1e-3
"""Gain relative to the object's largest below which a mode does not count for its brightness: inaudible gains would
dominate a slope of logarithms."""
_SCATTER = 0.5
"""Standard deviation of a mode's gain about the slope, logarithm: contacts and shapes differ."""


def gain_slope(frequency: Float64[Tensor, " modes"], size: Float64[Tensor, " modes"]) -> float:
    """Return the slope of gains over frequency, decibels an octave, by least squares over the modes within 60 dB."""
    audible = size > _MIN_RELATIVE_GAIN * size.max()
    octave, loud = torch.log2(frequency[audible]), 20 * torch.log10(size[audible])
    apart = octave - octave.mean()
    spread = float((apart**2).sum())
    return float((apart * (loud - loud.mean())).sum()) / spread if spread > 0 else 0.0


def _synthetic(
    log: Float64[Tensor, " quantiles"], slope: float, material: Material, field: SoundField, generator: torch.Generator
) -> Float[Tensor, "1 samples"]:
    """Return an impact, as long as the field's sounds, with frequencies by the quantiles of their logarithms."""
    drawn = (torch.arange(_MODES) + torch.rand(_MODES, generator=generator)).double() / _MODES
    place = (drawn * _QUANTILES - 0.5).clamp(0.0, _QUANTILES - 1.0)
    below = place.floor().long().clamp_max(_QUANTILES - 2)
    frequency = torch.exp(torch.lerp(log[below], log[below + 1], place - below))
    turns = torch.rand(_MODES, generator=generator)
    scatter = torch.randn(_MODES, generator=generator)
    audible = frequency < 0.5 * field.sample_rate
    size = torch.exp(_SCATTER * scatter) * 10 ** (slope * torch.log2(frequency / frequency[0]) / 20)
    damping = 0.5 * (material.alpha + material.beta * (2 * math.pi * frequency).square()).clamp_min(1e-3)
    signed = torch.where(turns < 0.5, -size, size).float()[None, audible]
    return synthesize(
        signed, frequency[audible], damping[audible], samples=field.samples, sample_rate=field.sample_rate
    )


_OCTAVES = 9
"""Of the analyzed band, down from half the sample rate."""
_PER_OCTAVE = 24
_WIDTH = 3.0
"""Standard deviation of the smoothing, in bands: an eighth of an octave."""
_MAX_LOG_PITCH = math.log(8.0)
"""Largest change of the pitch, logarithm."""
_MAX_LOG_DAMPING = math.log(64.0)
_FFT_SIZES = (2048, 1024, 512, 256)


def band_spectrum(sounds: Sounds) -> Float[Tensor, "contacts bands"]:
    """Return the share of each band, 24 an octave, in a sound's amplitudes: nine octaves up to half the sample rate.

    Smoothed over an eighth of an octave; sums to one, so that level and unit do not matter.
    """
    power = torch.fft.rfft(sounds).abs().square()
    bins = power.shape[1]
    # Octaves below half the rate, the last bin; the first bin, no frequency at all, is left out.
    place = torch.arange(1, bins, dtype=torch.float64) / (bins - 1)
    band = (_PER_OCTAVE * (_OCTAVES + torch.log2(place))).floor().long().clamp_max(_OCTAVES * _PER_OCTAVE - 1)
    inside = band >= 0
    energy = power.new_zeros(len(power), _OCTAVES * _PER_OCTAVE).index_add(1, band[inside], power[:, 1:][:, inside])
    reach = math.ceil(4 * _WIDTH)
    bell = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / _WIDTH).square()).to(energy)
    smooth = torch.nn.functional.conv1d(energy[:, None], (bell / bell.sum())[None, None], padding=reach)[:, 0]
    amplitude = smooth.clamp_min(0.0).sqrt()
    return amplitude / amplitude.sum(dim=1, keepdim=True).clamp_min(torch.finfo(amplitude.dtype).tiny)


def _quantiles(spectrum: Float[Tensor, " bands"]) -> Float[Tensor, " quantiles"]:
    """Return the frequencies below which 5, 10, ... 95 % of a spectrum lie, as logarithms up to a constant."""
    shares = torch.linspace(0.05, 0.95, 19, dtype=spectrum.dtype)
    below = torch.cumsum(spectrum, dim=0)
    band = torch.searchsorted(below / below[-1], shares).clamp(0, len(spectrum) - 1)
    return band.to(spectrum) * (math.log(2.0) / _PER_OCTAVE)
