"""Spectrograms of recordings and renderings side by side, with a logarithmic frequency axis."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from avmsf.modal.config import scaled_fft_size
from avmsf.modal.spectra import magnitude_stft
from avmsf.plotting.style import SEQUENTIAL, styled, titled_figure

LOWEST_HZ, HIGHEST_HZ, SECONDS = 20.0, 20000.0, 1.0
"""Band and time of the paper's spectrograms (its figure of qualitative comparisons)."""
RANGE_DB = 80.0
"""Levels further below the loudest one have the darkest color."""
_TICKS_HZ = (20.0, 100.0, 1000.0, 10000.0, 20000.0)
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
    contacts: Mapping[str, Mapping[str, Float[Tensor, " _samples"]]],
    columns: Sequence[str],
    *,
    sample_rate: float,
    highest: float = HIGHEST_HZ,
    normalize: bool = True,
    title: str,
) -> Figure:
    """Draw a row for each contact and a column for each of `columns`, the recording first, in the paper's settings.

    20 Hz to 20 kHz (or `highest`, or half of `sample_rate`, if these are lower), the first second, and every sound
    scaled so that its samples span (-1, 1); without `normalize` a row is scaled by its first sound. The colors of a row
    span 80 dB below the loudest level of its first column. A column without a sound at a contact has an empty panel.
    """
    top = min(HIGHEST_HZ, highest, 0.5 * sample_rate)
    bottom = min(LOWEST_HZ, top / 50)
    figure = titled_figure(title, max(8.0, 2.3 * len(columns) + 1.2), max(3.4, 2.2 * len(contacts) + 0.8))
    grid = figure.subplots(len(contacts), len(columns), sharex=True, sharey=True, squeeze=False)
    mesh: QuadMesh | None = None
    longest = 0.0
    for row, (contact, sounds) in zip(grid, contacts.items(), strict=True):
        loudest: float | None = None
        peak = 1.0
        for axes, column in zip(row, columns, strict=True):
            if column in sounds:
                start = sounds[column][: max(1, round(SECONDS * sample_rate))].double()
                if normalize or loudest is None:
                    peak = max(float(start.abs().max()), 1e-30)
                levels = log_spectrogram(start / peak, sample_rate=sample_rate, lowest=bottom, highest=top)
                loudest = float(levels.max()) if loudest is None else loudest
                # Frames are centered on 0, 1, 2, ... hops.
                times = (np.arange(levels.shape[1] + 1) - 0.5) * _hop(len(start)) / sample_rate
                bands = np.geomspace(bottom, top, _HEIGHT + 1)
                mesh = axes.pcolormesh(times, bands, (levels - loudest).numpy(), rasterized=True, **_LEVELS)
                longest = max(longest, len(start) / sample_rate)
        row[0].set_ylabel(f"{contact}\nfrequency (Hz)")
    for axes in grid.flat:
        axes.set(yscale="log", xlim=(0.0, longest or SECONDS), ylim=(bottom, top))
        axes.yaxis.set_major_locator(FixedLocator([mark for mark in _TICKS_HZ if bottom <= mark <= top]))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    for axes, column in zip(grid[0], columns, strict=True):
        axes.set_title(column, wrap=True)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    if mesh is not None:
        figure.colorbar(mesh, ax=grid, label="level (dB re loudest at left)", shrink=0.8)
    return figure


def _hop(samples: int, width: int = _WIDTH) -> int:
    return max(1, -(-samples // width))
