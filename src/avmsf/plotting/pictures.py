"""Pictures of a sound field: its modes, its gains, spectrograms of its sounds; and a function that writes a figure."""

import io
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.modes import ModalBank
from avmsf.modal.spectra import magnitude_stft
from avmsf.plotting.objects import name_axes, plane_of, view_from
from avmsf.plotting.style import DIVERGING, FIRST, SECOND, SEQUENTIAL, scatter_surface, styled, titled_figure

_SIDE = (-60.0, 38.0)
"""From where gains are seen: a little above, into what is open there."""


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure as its file's ending says. Raises EvaluationError for another ending than png, pdf or svg."""
    ending = path.suffix.lower().lstrip(".")
    if ending not in ("png", "pdf", "svg"):
        got = path.suffix or "no ending"
        raise EvaluationError.expected("a name that ends in .png, .pdf or .svg", path.suffix, got=got, file=path)
    memory = io.BytesIO()
    FigureCanvasAgg(figure).print_figure(memory, format=ending, dpi=150)
    write_whole(path, memory.getvalue())


@styled
def draw_modes(
    bank: ModalBank, level_db: Float[Tensor, " modes"], *, title: str, is_mode: Bool[Tensor, " modes"] | None = None
) -> Figure:
    """Draw each mode's level (dB) and decay time (T60, s) over its frequency (logarithmic) as stems.

    Those of most energy are labelled. Supporting poles, which are no modes, are gray.
    """
    figure = titled_figure(title, 9, 5.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    frequency, level = bank.frequency.numpy(), level_db.numpy()
    bottom = 10.0 * math.floor(float(level.min()) / 10) - 5.0
    kept = np.ones(len(level), dtype=bool) if is_mode is None else is_mode.numpy()
    t60 = bank.t60.numpy()
    for axes, heights, foot, own in ((upper, level, bottom, FIRST), (lower, t60, 0.0, SECOND)):
        for rows, color in ((~kept, "lightgray"), (kept, own)):
            if rows.any():
                marks, lines, base = axes.stem(frequency[rows], heights[rows], bottom=foot)
                marks.set(color=color, markersize=4)
                lines.set(color=color, linewidth=1)
                base.set_visible(False)
    top = float(level.max()) + 0.12 * (float(level.max()) - bottom)
    upper.set(ylim=(bottom, top), ylabel="level (dB re strongest pole)")
    for row in _apart(frequency, np.where(kept, level + 10 * np.log10(t60), -np.inf), most=8):
        offset: dict[str, Any] = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center"}
        upper.annotate(f"{frequency[row]:.4g}", (frequency[row], level[row]), fontsize=8, **offset)
    lower.set_ylim(bottom=0.0)
    lower.set(xscale="log", xlabel="frequency (Hz)", ylabel="decay time T60 (s)")
    lower.set_xlim(0.9 * float(frequency.min()), 1.1 * float(frequency.max()))
    lower.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    for axes in (upper, lower):
        axes.grid()
    return figure


@styled
def draw_gains(
    points: Float[Tensor, "points 3"],
    gains: Float[Tensor, "points modes"],
    bank: ModalBank,
    *,
    title: str,
    most: int = 6,
) -> Figure:
    """Draw the signed gains of the modes of most energy on the object's points (object frame), each on its own scale.

    An object that is flat along an axis is drawn in its plane, any other from one side.
    """
    frequency = bank.frequency
    strongest = torch.argsort(gains.square().mean(0) / bank.damping, descending=True)[:most]
    # Poles that are all without a pitch leave no mode to draw.
    columns = max(1, min(3, len(strongest)))
    rows = max(1, math.ceil(len(strongest) / columns))
    places, plane = points.double().numpy(), plane_of(points.double().numpy())
    view = view_from(_SIDE) if plane is None else plane
    seen = places @ view.T
    wide, high, _ = np.ptp(seen, axis=0)
    height = float(np.clip(3.2 * high / wide + 0.8, 1.6, 5.0))
    figure = titled_figure(
        f"{title}\n(color: signed gain, in the unit of the recordings)", 4.4 * columns, height * rows + 0.5
    )
    for number, mode in enumerate(sorted(strongest.tolist(), key=lambda mode: float(frequency[mode]))):
        values = gains[:, mode].numpy()
        scale = {"cmap": DIVERGING, "vmin": -np.abs(values).max(), "vmax": np.abs(values).max()}
        axes = figure.add_subplot(rows, columns, number + 1)
        drawn = scatter_surface(axes, seen, values, inches=3.0, **scale)
        if plane is None:
            name_axes(axes, view)
        else:
            across, along = ("xyz"[int(row.argmax())] for row in plane[:2])
            axes.set(xlabel=f"{across} (m)", ylabel=f"{along} (m)")
        axes.set_title(f"{float(frequency[mode]):.4g} Hz")
        figure.colorbar(drawn, ax=axes, shrink=0.8, pad=0.02).ax.tick_params(labelsize=8)
    return figure


def _apart(frequency: np.ndarray, energy: np.ndarray, *, most: int) -> list[int]:
    """Return the modes of most energy whose labels do not run into one another."""
    chosen: list[int] = []
    places = np.log(frequency)
    for row in np.argsort(-energy)[: np.isfinite(energy).sum()].tolist():
        if len(chosen) < most and all(abs(places[row] - places[one]) > 0.05 * np.ptp(places) for one in chosen):
            chosen.append(row)
    return chosen


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
