"""Everything that is written of a results folder: the summary, the times, the tables, the page."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from avmsf.bench.markdown import markdown
from avmsf.bench.page import page
from avmsf.bench.reporttables import Section, sections
from avmsf.bench.results import ResultsFolder, write_json
from avmsf.bench.summary import summarise, times_of
from avmsf.errors import EvaluationError
from avmsf.files import write_whole

SUMMARY, TIMES, TABLES, PAGE = "summary.json", "times.json", "report.md", "report.html"
"""The files, beside `protocol.json` and the folder `objects`."""


def write_summary(results: ResultsFolder, *, subsets: Mapping[str, frozenset[str]]) -> dict[str, Any]:
    """Write `summary.json`, `times.json` and `report.md` of what the folder holds by now, and return the summary."""
    records, identity = results.records(), results.identity()
    summary = summarise(records, identity, subsets=subsets)
    write_json(results.path / SUMMARY, summary)
    write_json(results.path / TIMES, times_of(records))
    _write_text(results.path / TABLES, markdown(sections(records, identity, subsets=subsets)))
    return summary


def write_page(results: ResultsFolder, *, subsets: Mapping[str, frozenset[str]]) -> list[Section]:
    """Write `report.html`, and return its parts. Raises EvaluationError where a kept sound is gone."""
    records = results.records()
    parts = sections(records, results.identity(), subsets=subsets)
    _write_text(results.path / PAGE, page(parts, records, results.path))
    return parts


def _write_text(path: Path, text: str) -> None:
    write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=EvaluationError)
