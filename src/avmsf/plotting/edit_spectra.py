"""Pictures of an edit: an object's modes before and after it, and the spectrograms of one impact."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter
from torch import Tensor

from avmsf.field.sound_field import SoundField
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.spectra import magnitude_stft
from avmsf.plotting.style import FIRST, SECOND, SEQUENTIAL, styled

_RANGE_DB = 80.0
"""What is shown below the loudest."""
_POINTS = 256
"""Points of the object that a mode's level is taken over, at most."""
_BANDS = 3
"""Bands an octave in which modes are counted."""


@dataclass(frozen=True, eq=False)
class HeardModes:
    """An object's modes as they are heard on average over its surface."""

    frequency: Float64[Tensor, " modes"]
    """Hz."""
    t60: Float64[Tensor, " modes"]
    """Time in which each falls by 60 dB, s."""
    size: Float64[Tensor, " modes"]
    """Root mean square amplitude over the surface; zero for modes that are silent."""

    @classmethod
    def of(cls, field: SoundField) -> "HeardModes":
        """Return those of a field."""
        points = field.gain_field.points
        known = field.known(points[:: max(1, -(-len(points) // _POINTS))])
        size = torch.where(field.audible, known.power.mean(0).sqrt(), 0.0)
        return cls(field.bank.frequency, np.log(1000.0) / field.bank.damping, size)

    def level_db(self, reference: float) -> Float64[Tensor, " modes"]:
        """Return levels over an amplitude, dB; -inf for silent modes."""
        return 20.0 * torch.log10(self.size / max(reference, torch.finfo(torch.float64).tiny))


@styled
def draw_edit(before: HeardModes, after: HeardModes, *, sample_rate: float, title: str) -> Figure:
    """Draw levels, ring times and the number of modes over frequency (logarithmic), before and after an edit.

    Modes that are silent have no level; the band above half the sample rate (Hz), where all are, is shaded.
    """
    figure = Figure(figsize=(9, 8.4), layout="constrained")
    levels, rings, counts = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
    loudest = float(before.size.max())
    drawn = [("before", before, FIRST), ("after", after, SECOND)]
    tops = [each.level_db(loudest).max().item() for _, each, _ in drawn if bool((each.size > 0).any())]
    top = max([0.0, *tops])
    for name, modes, color in drawn:
        heard = (modes.size > 0).numpy()
        frequency, t60 = modes.frequency.numpy(), modes.t60.numpy()
        level = np.maximum(modes.level_db(loudest).numpy()[heard], top - _RANGE_DB)
        levels.vlines(frequency[heard], top - _RANGE_DB, level, colors=color, linewidths=1.2, alpha=0.7)
        levels.plot(frequency[heard], level, "o", color=color, markersize=4, label=name)
        rings.plot(frequency[heard], t60[heard], "o", color=color, markersize=4, alpha=0.8)
        rings.plot(frequency[~heard], t60[~heard], "o", color=color, markersize=4, mfc="none")
    for one, other in zip(_places(before), _places(after), strict=True):
        rings.plot([one[0], other[0]], [one[1], other[1]], color="gray", linewidth=0.5, alpha=0.5, zorder=0)
    _count(counts, drawn)
    levels.set_ylim(top - _RANGE_DB, top + 6.0)
    levels.set_ylabel("level (dB re strongest mode before)")
    levels.legend()
    rings.set_yscale("log")
    rings.set_ylabel("decay time T60 (s)")
    counts.set_ylabel("modes per third-octave band")
    counts.set_xlabel("frequency (Hz); hollow: silent")
    for axes in (levels, rings, counts):
        axes.set_xscale("log")
        axes.grid(which="both")
        _shade(axes, 0.5 * sample_rate, max(float(each.frequency.max()) for _, each, _ in drawn))
    for axis in (counts.xaxis, rings.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    figure.suptitle(title)
    return figure


@styled
def draw_sound_change(
    before: Float[Tensor, " samples"], after: Float[Tensor, " samples"], *, sample_rate: float, title: str
) -> Figure:
    """Draw the spectrograms of two sounds side by side, each on the scale of its own loudest point."""
    fft_size = scaled_fft_size(1024, sample_rate=sample_rate)
    hop = max(1, fft_size // 8)
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    spectra = magnitude_stft(torch.stack([before, after]), fft_size=fft_size, hop=hop)
    ends = (-hop / 2 / sample_rate, (spectra.shape[2] - 0.5) * hop / sample_rate, 0.0, sample_rate / 2000.0)
    for axes, spectrum, what in zip(grid, spectra, ("before", "after"), strict=True):
        level = 20 * torch.log10((spectrum / spectrum.max().clamp_min(1e-30)).clamp_min(1e-10))
        image = axes.imshow(
            level.numpy(),
            origin="lower",
            aspect="auto",
            extent=ends,
            cmap=SEQUENTIAL,
            vmin=-_RANGE_DB,
            vmax=0.0,
            interpolation="nearest",
        )
        axes.set_title(what)
        axes.set_xlabel("time (s)")
    grid[0].set_ylabel("frequency (kHz)")
    figure.colorbar(image, ax=grid, label="level (dB re maximum of each)", shrink=0.8)
    figure.suptitle(title)
    return figure


def _places(modes: HeardModes) -> list[tuple[float, float]]:
    return list(zip(modes.frequency.tolist(), modes.t60.tolist(), strict=True))


def _count(axes: Axes, drawn: list[tuple[str, HeardModes, str]]) -> None:
    """Draw how many modes there are in each band, silent ones left out."""
    octaves = [modes.frequency[modes.size > 0].log2().numpy() * _BANDS for _, modes, _ in drawn]
    both = np.concatenate(octaves)
    if not len(both):
        return
    edges = np.arange(np.floor(both.min()), np.ceil(both.max()) + 1.5)
    for (_, _, color), places in zip(drawn, octaves, strict=True):
        axes.stairs(np.histogram(places, edges)[0], 2.0 ** (edges / _BANDS), color=color, fill=True, alpha=0.35)


def _shade(axes: Axes, start: float, highest: float) -> None:
    if highest >= start:
        axes.axvspan(start, 1.1 * highest, color="gray", alpha=0.2, linewidth=0)
