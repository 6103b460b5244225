"""What an evaluation stands on: finite elements against theory, and how RealImpact's files open."""

from benchmarks.datasets import measure_realimpact
from benchmarks.fem import measure_fem
from benchmarks.report import Options, Report

PARTS = {"fem": measure_fem, "realimpact": measure_realimpact}


def measure(options: Options) -> Report:
    """Return the figures of the chosen parts."""
    report = Report()
    for part in options.parts:
        report += PARTS[part](options)
    return report
