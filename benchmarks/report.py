"""What a benchmark prints: how to read the figures, tables, and as the last line all of them as one JSON object."""

import json
import math
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO


@dataclass(frozen=True)
class Options:
    """What of a benchmark is run."""

    parts: tuple[str, ...]
    """Its parts, by name."""
    quick_look: bool = False
    """Small settings that show that everything runs; the figures are not the benchmark's then."""
    paper_minutes: float = 6.0
    """Time for a real run of the paper's recipe, minutes."""
    sim20: Path | None = None
    """Folder of the objects that `avmsf simulate sim-20` makes; None to simulate them."""
    objects: tuple[str, ...] = ()
    """Some of these objects; none for all."""
    clouds: Path | None = None
    """Folder that keeps Gaussians fitted to these objects; None to fit them again."""
    weights: Path | None = None
    """File of the weights of sonicgauss-small; None to keep none."""
    device: str = "cpu"
    """What the steps of `step` are taken on."""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of figures under one heading."""

    title: str
    columns: tuple[str, ...]
    """Headings, the rows' names first."""
    rows: Sequence[Sequence[str | float]]

    def lines(self) -> list[str]:
        """Return the table as text, names to the left and figures to the right."""
        cells = [list(self.columns)] + [[_text(value) for value in row] for row in self.rows]
        widths = [max(len(row[place]) for row in cells) for place in range(len(self.columns))]
        aligned = [
            "  ".join(
                cell.ljust(width) if place == 0 else cell.rjust(width)
                for place, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in cells
        ]
        return [self.title, aligned[0], "-" * (sum(widths) + 2 * (len(widths) - 1)), *aligned[1:]]


@dataclass(frozen=True, eq=False)
class Report:
    """A benchmark's outcome."""

    conventions: tuple[str, ...] = ()
    """What the figures are and what they were taken on, a sentence or two each."""
    tables: tuple[Table, ...] = ()
    figures: Mapping[str, float] = field(default_factory=dict)
    """Every figure under its key."""

    def __add__(self, other: "Report") -> "Report":
        return Report(
            self.conventions + other.conventions, self.tables + other.tables, {**self.figures, **other.figures}
        )


def show(report: Report, options: Options, *, name: str, out: TextIO | None = None) -> None:
    """Print a report to `out`, or to standard output; its last line is JSON whatever was measured."""
    out = sys.stdout if out is None else out
    lines = [f"benchmark {name}: {', '.join(options.parts)}"]
    if options.quick_look:
        lines.append("QUICK LOOK: small settings, to see that everything runs. These are not the benchmark's figures.")
    for each in report.conventions:
        lines += textwrap.wrap(each, 116, initial_indent="  ", subsequent_indent="    ")
    for table in report.tables:
        lines += ["", *table.lines()]
    # JSON knows neither NaN nor infinity: a figure that could not be measured has no key, and is named instead.
    unknown = [key for key, value in report.figures.items() if not math.isfinite(value)]
    if unknown:
        lines += ["", f"not measured, and left out below: {', '.join(unknown)}"]
    figures = {key: float(value) for key, value in report.figures.items() if math.isfinite(value)}
    figures["quick_look"] = float(options.quick_look)
    print("\n".join([*lines, "", json.dumps(figures, allow_nan=False)]), file=out, flush=True)


def log(message: str) -> None:
    """Say how far a benchmark is, beside its report."""
    print(message, file=sys.stderr, flush=True)


def _text(value: str | float) -> str:
    if isinstance(value, str):
        return value
    if not math.isfinite(value):
        return "-"
    return f"{value:d}" if isinstance(value, int) else f"{value:.4g}"
