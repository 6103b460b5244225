"""How files and requests that are damaged, oversized or hostile are answered; tracebacks and crashes must be 0."""

from benchmarks.report import Options, Report, Table
from benchmarks.robustness import files, studio

PARTS = ("files", "studio")


def measure(options: Options) -> Report:
    """Run the parts that are asked for."""
    report = files.measure(options) if "files" in options.parts else Report()
    return report + _measure_studio(options) if "studio" in options.parts else report


def _measure_studio(options: Options) -> Report:
    """Return the counts that the studio's fuzzer finds, as one row."""
    counts = studio.run(quick_look=options.quick_look)
    figures = {f"studio.{name}": float(value) for name, value in counts.items()}
    return Report(tables=(Table("studio", ("studio", *counts), [["requests", *counts.values()]]),), figures=figures)
