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
    first: Float[Tensor, "rows samples"],
    second: Float[Tensor, "rows samples"],
    *,
    sample_rate: float,
    names: Sequence[str],
    title: str,
    columns: tuple[str, str] = ("recorded", "rendered"),
    shared_scale: bool = True,
) -> Figure:
    """Draw sounds side by side with a linear frequency axis, over the maximum of the first one or each over its own.

    Shows the band and the time in which the first ones have energy.
    """
    figure = titled_figure(title, 10, 2.1 * len(first) + 1.2)
    grid = figure.subplots(len(first), 2, sharex=True, sharey=True, squeeze=False)
    fft_size = scaled_fft_size(1024, sample_rate=sample_rate)
    hop = max(1, fft_size // 8)
    step = hop / sample_rate
    spectra = [magnitude_stft(sounds, fft_size=fft_size, hop=hop) for sounds in (first, second)]
    for row, name in enumerate(names):
        for axes, spectrum, what in zip(grid[row], spectra, columns, strict=True):
            reference = max(float((spectra[0] if shared_scale else spectrum)[row].max()), 1e-30)
            image = axes.imshow(
                20 * torch.log10((spectrum[row] / reference).clamp_min(1e-10)).numpy(),
                origin="lower",
                aspect="auto",
                extent=(-step / 2, (spectrum.shape[2] - 0.5) * step, 0.0, sample_rate / 2),
                interpolation="nearest",
                **_LEVELS,
            )
            axes.set_title(f"{name}: {what}" if name else what)
        grid[row, 0].set_ylabel("frequency (Hz)")
    highest, latest = _energy_extent(spectra[0])
    grid[0, 0].set_ylim(0.0, highest * sample_rate / 2)
    grid[0, 0].set_xlim(0.0, max(latest * first.shape[1] / sample_rate, 4 * step))
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    label = f"level (dB re maximum of {f'the {columns[0]}' if shared_scale else 'each'})"
    figure.colorbar(image, ax=grid, label=label, shrink=0.8)
    return figure


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
                start = sounds[method][: max(1, round(SECONDS * sample_rate))].double()
                start = start / start.abs().max().clamp_min(torch.finfo(torch.float64).tiny)
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


def _hop(samples: int, width: int = _WIDTH) -> int:
    return max(1, -(-samples // width))


def _set_axes(axes: Axes, seconds: float, band: tuple[float, float]) -> None:
    axes.set(yscale="log", xlim=(0.0, seconds), ylim=band)
    marks = [mark for mark in (20.0, 100.0, 1000.0, 10000.0, 20000.0) if band[0] <= mark <= band[1]]
    axes.yaxis.set_major_locator(FixedLocator(marks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


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
