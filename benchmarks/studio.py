"""The studio: how true and how fast the page sounds, how soon it can be struck, exports, and pictures."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks import studioexports, studiosound
from benchmarks.report import Options, Report, Table
from benchmarks.studiopage import draw_screenshots, measure_page

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "studio"


def measure(options: Options) -> Report:
    """Run the parts that are asked for; `screenshots` writes the pictures in the documentation anew."""
    report = Report()
    for part in options.parts:
        report += _RUNNERS[part](options)
    return report


def _page(options: Options) -> Report:
    return measure_page()


def _exports(part: str) -> Callable[[Options], Report]:
    return lambda options: studioexports.measure(replace(options, parts=(part,)))


def _screenshots(options: Options) -> Report:
    if options.quick_look:
        return Report()
    written = draw_screenshots(PICTURES)
    rows = [(path.name, round(path.stat().st_size / 1000)) for path in written]
    return Report(tables=(Table(f"pictures in {PICTURES}", ("file", "kB"), rows),))


_RUNNERS: dict[str, Callable[[Options], Report]] = {
    "sound": studiosound.measure,
    "page": _page,
    **{part: _exports(part) for part in studioexports.PARTS},
    "screenshots": _screenshots,
}
PARTS = tuple(_RUNNERS)
