"""The initial edit towards a reference: a global search for the common pitch and damping.

Modes are sparse: if a mode and its target are a third of an octave apart, the L1 distance of the spectra has no
gradient. So the pitch comes from optimal transport, which in one dimension is a match of quantiles: a common factor
on all frequencies moves the quantiles of the spectrum along a logarithmic axis by one step, and the best of them is the
mean or median difference of two spectra's. A grid over the smoothed spectra's overlap proposes one more. The damping is
searched on a grid for each proposal, and the loss of the optimization chooses. Only the target's own duration counts:
beyond its end it continues with the rendered sound, and a longer decay would reduce the relative error.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.editing.modal_edit import FieldAtContacts, ModalEdit
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.modal.config import scaled_fft_size

TargetFunction = Callable[
    [Float[Tensor, "contacts samples"]], tuple[Float[Tensor, "contacts samples"], Float[Tensor, "contacts samples"]]
]
"""Gives the targets of sounds, and the weight of each sample, 0 where there is no target, at most 1."""
_OCTAVES = 9
"""Of the analyzed band, down from half the sample rate."""
_PER_OCTAVE = 24
_WIDTH = 3.0
"""Standard deviation of the smoothing, in bands: an eighth of an octave."""
_MAX_LOG_PITCH = math.log(8.0)
"""Largest change of the pitch, logarithm."""
_MAX_LOG_DAMPING = math.log(64.0)
_MAX_CONTACTS = 6
"""Contacts of the search."""
_FFT_SIZES = (2048, 1024, 512, 256)


def band_spectrum(sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, "contacts bands"]:
    """Return the share of each band, 24 an octave, in a sound's amplitudes: nine octaves up to half the sample rate.

    Smoothed over an eighth of an octave; sums to one, so that level and unit do not matter.
    """
    power = torch.fft.rfft(sounds).abs().square()
    bins = power.shape[1]
    # Octaves below half the rate, the last bin; the first bin, no frequency at all, is left out.
    place = torch.arange(1, bins, device=sounds.device, dtype=torch.float64) / (bins - 1)
    band = (_PER_OCTAVE * (_OCTAVES + torch.log2(place))).floor().long().clamp_max(_OCTAVES * _PER_OCTAVE - 1)
    inside = band >= 0
    energy = power.new_zeros(len(power), _OCTAVES * _PER_OCTAVE).index_add(1, band[inside], power[:, 1:][:, inside])
    reach = math.ceil(4 * _WIDTH)
    bell = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=sounds.device) / _WIDTH).square()).to(energy)
    smooth = torch.nn.functional.conv1d(energy[:, None], (bell / bell.sum())[None, None], padding=reach)[:, 0]
    amplitude = smooth.clamp_min(0.0).sqrt()
    return amplitude / amplitude.sum(dim=1, keepdim=True).clamp_min(torch.finfo(amplitude.dtype).tiny)


def search_start(rendered: FieldAtContacts, targets_of: TargetFunction) -> ModalEdit:
    """Return the edit by a common pitch and damping alone, up to 8 and 64 times either way, of least spectral error."""
    rendered = rendered.first(_MAX_CONTACTS)
    best = (math.inf, 0.0, 0.0)
    for pitch in _pitches(rendered, targets_of):
        step, damping = _MAX_LOG_DAMPING / 4, 0.0
        tried: dict[float, float] = {}
        # Nine places over the whole range, then three refinements about the best.
        around = [step * place for place in range(-4, 5)]
        for _ in range(4):
            for each in around:
                if round(each, 9) not in tried:
                    tried[round(each, 9)] = _error(rendered, targets_of, pitch, each)
            damping, step = min(tried, key=lambda each: tried[each]), step / 2
            around = [max(-_MAX_LOG_DAMPING, damping - step), min(_MAX_LOG_DAMPING, damping + step)]
        best = min(best, (tried[damping], pitch, damping))
    return ModalEdit.none(rendered.bank, pitch=best[1], damping=best[2])


def _pitches(rendered: FieldAtContacts, targets_of: TargetFunction) -> list[float]:
    """Return proposals of log alpha: that of no change, and those by quantiles and overlap."""
    sounds = rendered.sounds(ModalEdit.none(rendered.bank))
    targets, weight = targets_of(sounds)
    own, aim = (band_spectrum(weight * each).mean(dim=0) for each in (sounds, targets))
    differences = (_quantiles(aim) - _quantiles(own)).clamp(-_MAX_LOG_PITCH, _MAX_LOG_PITCH)
    # Moved by whole bands along the logarithmic axis, spectra overlap more or less.
    most = round(_MAX_LOG_PITCH / math.log(2.0) * _PER_OCTAVE)
    padded = torch.nn.functional.pad(own, (most, most))
    moved = padded.unfold(0, len(own), 1).flip(0)
    overlap = (moved - aim).abs().sum(dim=1)
    shift = (int(overlap.argmin()) - most) * math.log(2.0) / _PER_OCTAVE
    return sorted({0.0, float(differences.mean()), float(differences.median()), shift})


def _quantiles(spectrum: Float[Tensor, " bands"]) -> Float[Tensor, " quantiles"]:
    """Return the frequencies below which 5, 10, ... 95 % of a spectrum lie, as logarithms up to a constant."""
    shares = torch.linspace(0.05, 0.95, 19, device=spectrum.device, dtype=spectrum.dtype)
    below = torch.cumsum(spectrum, dim=0)
    band = torch.searchsorted(below / below[-1], shares).clamp(0, len(spectrum) - 1)
    return band.to(spectrum) * (math.log(2.0) / _PER_OCTAVE)


def _error(rendered: FieldAtContacts, targets_of: TargetFunction, pitch: float, damping: float) -> float:
    sounds = rendered.sounds(ModalEdit.none(rendered.bank, pitch=pitch, damping=damping))
    if float(sounds.abs().max()) == 0.0:
        return math.inf
    sizes = [scaled_fft_size(size, sample_rate=rendered.sample_rate) for size in _FFT_SIZES]
    targets, weight = targets_of(sounds)
    target = spectral_target(weight * targets, fft_sizes=sizes, hops=[size // 4 for size in sizes])
    return float(spectral_loss(weight * sounds, target)) / len(sizes)
