"""Figures of edits: modes before and after, and CLAP scores over the steps."""

from collections.abc import Mapping, Sequence
from statistics import mean
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from avmsf.field.sound_field import SoundField
from avmsf.plotting.style import FIRST, SECOND, series_color, styled, titled_figure

_RANGE_DB = 80.0
"""What is shown below the loudest."""
_BANDS = 3
"""Bands an octave in which modes are counted."""


@styled
def draw_edit(before: SoundField, after: SoundField, *, title: str) -> Figure:
    """Draw levels, ring times and the number of modes over frequency (logarithmic), before and after an edit.

    Modes that are silent have no level; the band above half the sample rate, where all are, is shaded.
    """
    figure = titled_figure(title, 9, 8.4)
    levels, rings, counts = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
    loudest = before.amplitudes.max().clamp_min(torch.finfo(torch.float64).tiny)
    drawn = [("before", before, FIRST), ("after", after, SECOND)]
    top = max(0.0, 20.0 * float((after.amplitudes.max() / loudest).log10()))
    for name, field, color in drawn:
        audible = (field.amplitudes > 0).numpy()
        frequency, t60 = field.bank.frequency.numpy(), field.bank.t60.numpy()
        level = np.maximum(20.0 * (field.amplitudes / loudest).log10().numpy()[audible], top - _RANGE_DB)
        levels.vlines(frequency[audible], top - _RANGE_DB, level, colors=color, linewidths=1.2, alpha=0.7)
        levels.plot(frequency[audible], level, "o", color=color, markersize=4, label=name)
        rings.plot(frequency[audible], t60[audible], "o", color=color, markersize=4, alpha=0.8)
        rings.plot(frequency[~audible], t60[~audible], "o", color=color, markersize=4, mfc="none")
    banks = before.bank, after.bank
    moves = [torch.stack([getattr(bank, name) for bank in banks]).numpy() for name in ("frequency", "t60")]
    rings.plot(*moves, color="gray", linewidth=0.5, alpha=0.5, zorder=0)
    _count(counts, drawn)
    levels.set(ylim=(top - _RANGE_DB, top + 6.0), ylabel="level (dB re strongest mode before)")
    levels.legend()
    rings.set(yscale="log", ylabel="decay time T60 (s)")
    counts.set(xlabel="frequency (Hz); hollow: silent", ylabel="modes per third-octave band")
    highest, nyquist = max(float(bank.frequency.max()) for bank in banks), 0.5 * before.sample_rate
    for axes in (levels, rings, counts):
        axes.set_xscale("log")
        axes.grid(which="both")
        if highest >= nyquist:
            axes.axvspan(nyquist, 1.1 * highest, color="gray", alpha=0.2, linewidth=0)
    for axis in (counts.xaxis, rings.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    return figure


def _count(axes: Axes, drawn: list[tuple[str, SoundField, str]]) -> None:
    """Draw how many modes there are in each band, silent ones left out."""
    octaves = [field.bank.frequency[field.amplitudes > 0].log2().numpy() * _BANDS for _, field, _ in drawn]
    both = np.concatenate(octaves)
    if not len(both):
        return
    edges = np.arange(np.floor(both.min()), np.ceil(both.max()) + 1.5)
    for (_, _, color), places in zip(drawn, octaves, strict=True):
        axes.stairs(np.histogram(places, edges)[0], 2.0 ** (edges / _BANDS), color=color, fill=True, alpha=0.35)


Move: TypeAlias = tuple[Sequence[float], Sequence[float]]
"""Where an edited object's modes lie in an embedding before and after the edit."""
Curve: TypeAlias = Sequence[tuple[int, float]]
"""Steps of an edit and its CLAP score after each; step 0 is the object as it was."""


@styled
def draw_embedding(
    points: Float[np.ndarray, "objects 2"],
    materials: Sequence[str],
    moves: Mapping[str, Sequence[Move]],
    *,
    target: str,
    title: str,
) -> Figure:
    """Draw labelled objects in an embedding of their modes, and arrows from edited objects before to after the edit.

    One panel for each method of `moves`. A star marks the mean of the objects of the material `target`, from which the
    UMAP distance is measured.
    """
    figure = titled_figure(title, 4.2 * len(moves) + 1.6, 4.8)
    panels = figure.subplots(1, len(moves), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (method, changes) in zip(panels, moves.items(), strict=True):
        for number, material in enumerate(sorted(set(materials))):
            own = points[[each == material for each in materials]]
            axes.scatter(own[:, 0], own[:, 1], s=36, alpha=0.75, color=series_color(number), label=material)
        center = points[[material == target for material in materials]].mean(axis=0)
        axes.plot(*center, "*", color="black", markersize=13, label=f"mean of {target}")
        arrow = {"arrowstyle": "->", "color": "0.3", "shrinkA": 0, "shrinkB": 0}
        for before, after in changes:
            axes.annotate("", after, before, arrowprops=arrow)
        ends = np.asarray(changes, dtype=float).reshape(-1, 2, 2)
        axes.plot(*ends[:, 0].T, "o", mfc="white", color="black", markersize=6, label="before the edit")
        axes.plot(*ends[:, 1].T, "D", color="black", markersize=5, label="after the edit")
        axes.set_title(method)
        axes.set_xlabel("UMAP 1")
    panels[0].set_ylabel("UMAP 2")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper")
    return figure


@styled
def draw_clap_curves(curves: Mapping[str, Sequence[Curve]], *, title: str) -> Figure:
    """Draw the CLAP score over the steps: a thin line for each edit, a thick one for the mean of each method.

    The mean is taken at the steps that all edits of the method have.
    """
    figure = titled_figure(title, 7.0, 4.4)
    axes = figure.subplots()
    for number, (method, edits) in enumerate(curves.items()):
        color = series_color(number)
        for edit in edits:
            axes.plot(*zip(*edit, strict=True), color=color, linewidth=0.7, alpha=0.4)
        steps = sorted(set.intersection(*(set(dict(edit)) for edit in edits)))
        means = [mean(dict(edit)[step] for edit in edits) for step in steps]
        axes.plot(steps, means, "o-", color=color, linewidth=2.2, markersize=4, label=f"{method}, {len(edits)} edits")
    axes.set(xlabel="step", ylabel="CLAP score")
    axes.grid()
    axes.legend()
    return figure
