"""Spectrograms: of many methods with a logarithmic frequency axis, of two sounds with a linear one."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator, StrMethodFormatter
from torch import Tensor

from avmsf.modal.config import scaled_fft_size
from avmsf.modal.spectra import magnitude_stft
from avmsf.plotting.style import SEQUENTIAL, styled, titled_figure

LOWEST_HZ, HIGHEST_HZ, SECONDS = 20.0, 20000.0, 1.0
"""Band and time of the paper's spectrograms (its figure of qualitative comparisons)."""
RANGE_DB = 80.0
"""Levels further below the loudest one have the darkest color."""
_LEVELS: dict[str, Any] = {"cmap": SEQUENTIAL, "vmin": -RANGE_DB, "vmax": 0.0}
_WIDTH, _HEIGHT = 240, 160
"""Cells of a spectrogram: about one for each printed pixel."""


def log_spectrogram(
    sound: Float[Tensor, " samples"],
    *,
    sample_rate: float,
    lowest: float,
    highest: float,
    width: int = _WIDTH,
    height: int = _HEIGHT,
) -> Float64[Tensor, "height frames"]:
    """Return levels in dB, at most `width` frames, in `height` bands of equal ratio from `lowest` to `highest` (Hz).

    Each cell holds the largest bin within its band, or the nearest one, so that no narrow line falls between cells.
    """
    fft_size = scaled_fft_size(2048, sample_rate=sample_rate)
    spectrum = magnitude_stft(sound.double()[None], fft_size=fft_size, hop=_hop(len(sound), width))[0, :, :width]
    edges = np.geomspace(lowest, highest, height + 1) * fft_size / sample_rate
    rows = []
    for low, high in pairwise(edges.tolist()):
        first = min(round(low), spectrum.shape[0] - 1)
        rows.append(spectrum[first : max(first + 1, round(high))].amax(0))
    return 20 * torch.log10(torch.stack(rows).clamp(min=1e-9))


@styled
def draw_spectrograms(
    truth: Float[Tensor, "contacts samples"],
    predicted: Float[Tensor, "contacts samples"],
    *,
    sample_rate: float,
    names: Sequence[str],
    title: str,
) -> Figure:
    """Draw recorded and rendered sounds side by side, one row a contact, both on the recorded one's scale.

    Shows the band and the time in which the recordings have energy.
    """
    titles = [[f"{name}: {what}" for what in ("recorded", "rendered")] for name in names]
    sounds = torch.stack([truth, predicted], dim=1)
    label = "level (dB re maximum of the recording)"
    figure, axes = _draw_linear(sounds, titles, sample_rate=sample_rate, title=title, label=label, shared_scale=True)
    fft_size, hop = _linear_sizes(sample_rate)
    highest, latest = _energy_extent(magnitude_stft(truth, fft_size=fft_size, hop=hop))
    axes.set_ylim(0.0, highest * sample_rate / 2)
    axes.set_xlim(0.0, max(latest * truth.shape[1] / sample_rate, 4 * hop / sample_rate))
    return figure


@styled
def draw_sound_change(
    before: Float[Tensor, " samples"], after: Float[Tensor, " samples"], *, sample_rate: float, title: str
) -> Figure:
    """Draw the spectrograms of two sounds side by side, each on the scale of its own loudest point."""
    sounds, titles, label = torch.stack([before, after])[None], [["before", "after"]], "level (dB re maximum of each)"
    return _draw_linear(sounds, titles, sample_rate=sample_rate, title=title, label=label, shared_scale=False)[0]


def _draw_linear(
    sounds: Float[Tensor, "rows columns samples"],
    titles: Sequence[Sequence[str]],
    *,
    sample_rate: float,
    title: str,
    label: str,
    shared_scale: bool,
) -> tuple[Figure, Axes]:
    """Draw levels with a linear frequency axis, over the maximum of each sound or of the first one of its row.

    Return the figure and one of its axes, whose limits all share.
    """
    rows, columns, _ = sounds.shape
    figure = titled_figure(title, 10, 2.1 * rows + 1.2)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    fft_size, hop = _linear_sizes(sample_rate)
    step = hop / sample_rate
    for line, row, names in zip(grid, sounds, titles, strict=True):
        spectra = magnitude_stft(row, fft_size=fft_size, hop=hop)
        for axes, spectrum, name in zip(line, spectra, names, strict=True):
            reference = max(float((spectra[0] if shared_scale else spectrum).max()), 1e-30)
            image = axes.imshow(
                20 * torch.log10((spectrum / reference).clamp_min(1e-10)).numpy(),
                origin="lower",
                aspect="auto",
                extent=(-step / 2, (spectrum.shape[1] - 0.5) * step, 0.0, sample_rate / 2),
                interpolation="nearest",
                **_LEVELS,
            )
            axes.set_title(name)
        line[0].set_ylabel("frequency (Hz)")
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    figure.colorbar(image, ax=grid, label=label, shrink=0.8)
    return figure, grid[0, 0]


@styled
def draw_method_spectrograms(
    contacts: Mapping[str, Mapping[str, Float[Tensor, " _samples"]]],
    methods: Sequence[str],
    *,
    sample_rate: float,
    highest: float = HIGHEST_HZ,
    title: str,
) -> Figure:
    """Draw a row for each contact and a column for each of `methods`, the recording first, in the paper's settings.

    20 Hz to 20 kHz (or `highest`, or half of `sample_rate`, if these are lower), the first second, and every sound
    scaled so that its samples span (-1, 1). The colors of a row span 80 dB below the loudest level of its first column.
    A method without a sound at a contact has an empty panel.
    """
    top = min(HIGHEST_HZ, highest, 0.5 * sample_rate)
    bottom = min(LOWEST_HZ, top / 50)
    figure = titled_figure(title, 2.3 * len(methods) + 1.2, 2.2 * len(contacts) + 0.8)
    grid = figure.subplots(len(contacts), len(methods), sharex=True, sharey=True, squeeze=False)
    mesh: QuadMesh | None = None
    longest = 0.0
    for row, (contact, sounds) in zip(grid, contacts.items(), strict=True):
        loudest: float | None = None
        for axes, method in zip(row, methods, strict=True):
            if method in sounds:
                start = _first_second(sounds[method], sample_rate=sample_rate)
                levels = log_spectrogram(start, sample_rate=sample_rate, lowest=bottom, highest=top)
                loudest = float(levels.max()) if loudest is None else loudest
                # Frames are centered on 0, 1, 2, ... hops.
                times = (np.arange(levels.shape[1] + 1) - 0.5) * _hop(len(start)) / sample_rate
                bands = np.geomspace(bottom, top, _HEIGHT + 1)
                mesh = axes.pcolormesh(times, bands, (levels - loudest).numpy(), rasterized=True, **_LEVELS)
                longest = max(longest, len(start) / sample_rate)
        row[0].set_ylabel(f"{contact}\nfrequency (Hz)")
    for axes in grid.flat:
        _set_axes(axes, longest or SECONDS, (bottom, top))
    for axes, method in zip(grid[0], methods, strict=True):
        axes.set_title(method, wrap=True)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    if mesh is not None:
        figure.colorbar(mesh, ax=grid, label="level (dB, 0 = loudest of the first column)", shrink=0.8)
    return figure


def _first_second(sound: Float[Tensor, " samples"], *, sample_rate: float) -> Float64[Tensor, " kept"]:
    start = sound[: max(1, round(SECONDS * sample_rate))].double()
    return start / start.abs().max().clamp_min(torch.finfo(torch.float64).tiny)


def _hop(samples: int, width: int = _WIDTH) -> int:
    return max(1, -(-samples // width))


def _set_axes(axes: Axes, seconds: float, band: tuple[float, float]) -> None:
    axes.set_yscale("log")
    axes.set_ylim(*band)
    axes.set_xlim(0.0, seconds)
    marks = [mark for mark in (20.0, 100.0, 1000.0, 10000.0, 20000.0) if band[0] <= mark <= band[1]]
    axes.yaxis.set_major_locator(FixedLocator(marks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _linear_sizes(sample_rate: float) -> tuple[int, int]:
    """Return FFT size and hop of spectrograms with a linear frequency axis."""
    fft_size = scaled_fft_size(1024, sample_rate=sample_rate)
    return fft_size, max(1, fft_size // 8)


def _energy_extent(magnitude: Float[Tensor, "contacts bins frames"]) -> tuple[float, float]:
    """Return up to which part of the band and of the time there is energy within 50 and 60 dB of the greatest, up to 1.

    Energy by frequency is summed over time and the reverse, lest the click of the onset, which has all frequencies for
    a moment, count as much as what rings.
    """
    power = magnitude.square().sum(0)
    if not bool(power.any()):
        return 1.0, 1.0
    bins = torch.nonzero(power.sum(1) > 1e-5 * power.sum(1).max()).flatten()
    frames = torch.nonzero(power.sum(0) > 1e-6 * power.sum(0).max()).flatten()
    parts = (int(bins[-1]) / len(power), int(frames[-1]) / power.shape[1])
    return min(1.0, 1.15 * parts[0] + 0.01), min(1.0, 1.1 * parts[1] + 0.01)
