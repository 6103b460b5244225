"""Learning curves: the error of each method by the number of training contacts, and their picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from avmsf.errors import EvaluationError
from avmsf.evaluation.results import ObjectRecord
from avmsf.plotting.style import series_color, styled

_MARKS = "os^DvPX*<>hd"


@dataclass(frozen=True, eq=False)
class Curve:
    """One method's error over the number of training contacts."""

    method: str
    counts: tuple[int, ...]
    mean: tuple[float, ...]
    """Mean over starts of the mean over test contacts."""
    lowest: tuple[float, ...]
    """Of the best start."""
    highest: tuple[float, ...]
    """Of the worst start."""
    starts: tuple[int, ...]
    """How many starts have a value."""

    def values(self) -> dict[str, Any]:
        """Return the curve as plain values."""
        return {name: list(getattr(self, name)) for name in ("counts", "mean", "lowest", "highest", "starts")}


def curves(record: ObjectRecord, *, metric: str) -> tuple[Curve, ...]:
    """Return each method's curve of one metric, as far as there are values, in the order of the record.

    Raises EvaluationError where no method has the metric.
    """
    count_of = {case.key: int(case.label.split()[0]) for case in record.cases}
    found: dict[str, dict[int, list[float]]] = {}
    for outcome in record.outcomes:
        taken = [value for value in outcome.values.get(metric, ()) if value is not None and math.isfinite(value)]
        if taken and outcome.case in count_of:
            of_method = found.setdefault(outcome.method, {})
            of_method.setdefault(count_of[outcome.case], []).append(sum(taken) / len(taken))
    if not found:
        known = sorted({name for outcome in record.outcomes for name in outcome.values})
        reason = next((each.failure for each in record.outcomes if each.failure), record.failure)
        raise EvaluationError(
            f"{record.identifier}: expected a metric of {', '.join(known)}, got {metric!r}"
            if known
            else f"{record.identifier}: {(reason or 'no value').splitlines()[0]}",
            name="metric",
            value=metric,
        )
    return tuple(_curve(method, by_count) for method, by_count in found.items())


@styled
def draw_learning_curve(found: Sequence[Curve], *, metric: str, title: str) -> Figure:
    """Draw the error over the number of training contacts, both logarithmic, with the range over starts as a band."""
    figure = Figure(figsize=(8, 5.2), layout="constrained")
    axes = figure.subplots()
    order = sorted(found, key=lambda curve: -curve.mean[-1])
    for number, curve in enumerate(order):
        color = series_color(number)
        axes.plot(curve.counts, curve.mean, marker=_MARKS[number % len(_MARKS)], color=color, label=curve.method)
        axes.fill_between(curve.counts, curve.lowest, curve.highest, color=color, alpha=0.12, linewidth=0)
    counts = sorted({count for curve in found for count in curve.counts})
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = (float(np.log10(bound)) for bound in axes.get_ylim())
    axes.set_yticks([tick for tick in _TICKS if low <= math.log10(tick) <= high])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("training contacts (farthest-point sampling)")
    axes.set_ylabel("relative STFT error (1 = silence)" if metric == "relative_stft" else metric)
    axes.grid(which="major")
    axes.legend()
    figure.suptitle(title)
    return figure


_TICKS = tuple(lead * 10.0**power for power in range(-6, 7) for lead in (1, 1.5, 2, 3, 4, 5, 7))


def _curve(method: str, by_count: dict[int, list[float]]) -> Curve:
    counts = sorted(by_count)
    figures = [by_count[count] for count in counts]
    return Curve(
        method,
        tuple(counts),
        tuple(sum(each) / len(each) for each in figures),
        tuple(min(each) for each in figures),
        tuple(max(each) for each in figures),
        tuple(len(each) for each in figures),
    )
