"""What a field is for: other materials by physics, and edits towards a sound."""

from collections.abc import Callable

from benchmarks.changedmaterial import changed_material_report
from benchmarks.editingprotocol import measure_simulated
from benchmarks.report import Options, Report


def measure(options: Options) -> Report:
    """Run the parts that are asked for."""
    report = Report()
    for part in options.parts:
        report += _RUNNERS[part](options)
    return report


_RUNNERS: dict[str, Callable[[Options], Report]] = {
    "change-material": changed_material_report,
    "edit": measure_simulated,
}
PARTS = tuple(_RUNNERS)
