"""What a field is for: finding blows, other materials by physics, and edits towards a sound."""

from collections.abc import Callable
from dataclasses import replace

from benchmarks import editing, locating
from benchmarks.changedmaterial import changed_material_report
from benchmarks.report import Options, Report


def measure(options: Options) -> Report:
    """Run the parts that are asked for."""
    report = Report()
    for part in options.parts:
        report += _RUNNERS[part](options)
    return report


def _edit(options: Options) -> Report:
    return editing.measure(replace(options, parts=editing.PARTS))


def _locate(part: str) -> Callable[[Options], Report]:
    return lambda options: locating.measure(replace(options, parts=(part,)))


_RUNNERS: dict[str, Callable[[Options], Report]] = {
    **{part: _locate(part) for part in locating.PARTS},
    "change-material": changed_material_report,
    "edit": _edit,
}
PARTS = tuple(_RUNNERS)
