"""Sample efficiency: how the error falls with the number of places learnt from, method by method, and its picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from avmsf.bench.cases import Case, Places
from avmsf.bench.protocols import BASELINE, EvaluationProtocol
from avmsf.bench.results import ObjectRecord
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.scene.points import farthest_points
from avmsf.wording import counted

COUNTS = (3, 4, 6, 8, 12, 16, 24, 32, 48)
"""Numbers of places learnt from, where no others are asked for."""
METHODS = (
    BASELINE,
    "knn3-directions",
    "knn-gains",
    "spline-gains",
    "field-positions",
    "field-smooth",
    "field-elastic",
    "field-auto",
)
"""Methods that take part, where no others are asked for: those that need no pictures of the object. All but
the network, `field-positions`, take seconds for each figure."""
_LEFT = 0.25
"""Part of the places that is kept to be judged by, where counts are not asked for."""
_MARKS = "os^DvPX*<>hd"


@dataclass(frozen=True)
class Growing:
    """More and more places to learn from, spread as far apart as they go, from several first ones.

    Each choice holds the smaller ones of its start, and all of a start are judged by the same places: those that the
    largest leaves over.
    """

    counts: tuple[int, ...] = ()
    """Numbers of places to learn from; of `COUNTS` those that leave a quarter to judge by, where there is none."""
    starts: int = 3
    """First places, spread evenly over the table."""

    def __post_init__(self) -> None:
        if any(count < 1 for count in self.counts):
            raise EvaluationError(f"expected numbers of places of 1 or more, got {list(self.counts)}")
        if self.starts < 1:
            raise EvaluationError(f"starts = {self.starts}: expected 1 or more")

    def cases(self, impacts: Impacts) -> tuple[Case, ...]:
        """Return a case for each start and number. Raises EvaluationError where a number leaves nothing to judge by."""
        places = Places.of(impacts)
        total = len(places.rows)
        counts = self._counts(total)
        firsts = dict.fromkeys(round(number * total / self.starts) for number in range(self.starts))
        orders = {first: farthest_points(places.contacts, max(counts), start=first).tolist() for first in firsts}
        tests = {first: places.case("", order).test for first, order in orders.items()}
        return tuple(
            Case(
                label_of(count),
                places.case("", order[:count]).train,
                tests[first],
                fold=f"from {impacts.names[places.rows[first][0]]}",
            )
            for count in counts
            for first, order in orders.items()
        )

    def _counts(self, places: int) -> tuple[int, ...]:
        if not self.counts:
            counts = tuple(count for count in COUNTS if count <= (1.0 - _LEFT) * places)
            if counts:
                return counts
            raise EvaluationError(
                f"expected more places than {places} to learn from {min(COUNTS)} and be judged by a quarter: record "
                "more, or name the numbers of places"
            )
        if max(self.counts) >= places:
            raise EvaluationError(
                f"expected fewer places to learn from than all {places}, got {max(self.counts)}: ask for {places - 1} "
                "at most"
            )
        return tuple(sorted(set(self.counts)))


@dataclass(frozen=True, eq=False)
class Curve:
    """One method's error over the number of places that it learnt from."""

    method: str
    counts: tuple[int, ...]
    mean: tuple[float, ...]
    """Mean over starts of the mean over test contacts."""
    lowest: tuple[float, ...]
    """Of the best start."""
    highest: tuple[float, ...]
    """Of the worst start."""
    starts: tuple[int, ...]
    """How many starts have a figure."""

    def values(self) -> dict[str, Any]:
        """Return the curve as plain values."""
        return {name: list(getattr(self, name)) for name in ("counts", "mean", "lowest", "highest", "starts")}


def label_of(count: int) -> str:
    """Return what a number of places is called."""
    return counted(count, "place")


def efficiency_protocol(counts: Sequence[int], *, starts: int, methods: Sequence[str]) -> EvaluationProtocol:
    """Return the experiment as an evaluation runs it."""
    return EvaluationProtocol(
        "efficiency",
        "Learn from more and more places, spread as far apart as they go; test on those that the most leave over.",
        Growing(tuple(counts), starts),
        tuple(methods),
    )


def curves(record: ObjectRecord, *, metric: str) -> tuple[Curve, ...]:
    """Return each method's curve of one metric, as far as there are figures, in the order in which they came.

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
            f"{record.identifier}: no method has the metric {metric!r}; there are {', '.join(known)}"
            if known
            else f"{record.identifier}: {reason or 'nothing was measured'}"
        )
    return tuple(_curve(method, by_count) for method, by_count in found.items())


def draw_efficiency(found: Sequence[Curve], *, metric: str, title: str) -> Figure:
    """Draw the error over the number of places, both logarithmic, with the range over the starts as a band."""
    figure = Figure(figsize=(8, 5.2), layout="constrained")
    axes = figure.subplots()
    order = sorted(found, key=lambda curve: -curve.mean[-1])
    for number, curve in enumerate(order):
        colour = f"C{number % 10}"
        axes.plot(curve.counts, curve.mean, marker=_MARKS[number % len(_MARKS)], color=colour, label=curve.method)
        axes.fill_between(curve.counts, curve.lowest, curve.highest, color=colour, alpha=0.12, linewidth=0)
    counts = sorted({count for curve in found for count in curve.counts})
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = (float(np.log10(bound)) for bound in axes.get_ylim())
    axes.set_yticks([tick for tick in _TICKS if low <= math.log10(tick) <= high])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("places learnt from, spread as far apart as they go")
    axes.set_ylabel("relative STFT error (1 = silence)" if metric == "relative_stft" else metric)
    axes.grid(which="major", alpha=0.25)
    axes.legend(frameon=False)
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
