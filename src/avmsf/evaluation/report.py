"""The files of a results folder: summary, times, tables, and page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.evaluation.localization import read_map
from avmsf.evaluation.page import StoredSound, page, stored_contacts
from avmsf.evaluation.report_tables import Section, markdown, sections
from avmsf.evaluation.results import ObjectRecord, ResultsFolder, file_word, write_json
from avmsf.evaluation.summary import missing_of, summarize, times_of
from avmsf.plotting.contacts import draw_contact
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.spectrograms import draw_method_spectrograms

SUMMARY, TIMES, TABLES, PAGE = "summary.json", "times.json", "report.md", "report.html"
"""The files next to `protocol.json` and the folder `objects`."""
FIGURES = "figures"
"""Folder of the spectrograms, one file for each object, or for each object and case, and of the heat maps."""
_RECORDED = "recorded"
"""Title of the first column."""


def write_summary(
    results: ResultsFolder,
    *,
    subsets: Mapping[str, frozenset[str]],
    wanted: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Write `summary.json`, `times.json` and `report.md` of the folder's results, and return the summary.

    `wanted` are the methods of each object that the evaluation is of; those without results yet are named as missing.
    """
    records, identity = results.records(), results.identity()
    missing = missing_of(records, wanted or {})
    summary = summarize(records, identity, subsets=subsets, missing=missing)
    write_json(results.path / SUMMARY, summary)
    write_json(results.path / TIMES, times_of(records))
    _write_text(results.path / TABLES, markdown(sections(records, identity, missing=missing)))
    return summary


def write_page(results: ResultsFolder) -> list[Section]:
    """Write `report.html`, and return its parts. Raises EvaluationError where a stored sound is missing."""
    records = results.records()
    parts = sections(records, results.identity())
    _write_text(results.path / PAGE, page(parts, records, results.path))
    return parts


def write_figures(results: ResultsFolder) -> list[Path]:
    """Draw what is stored, and return the files.

    Sounds are drawn as spectrograms, the recording next to all methods, one PNG for each object and each label of its
    cases; localized contacts as heat maps with the true contact marked, one PNG for each field and recording. Raises
    EvaluationError where a stored file is missing.
    """
    drawn = (_write_spectrograms, _write_maps)
    return [path for record in results.records() for draw in drawn for path in draw(record, results.path)]


def _write_spectrograms(record: ObjectRecord, folder: Path) -> list[Path]:
    labels = list(dict.fromkeys(case.label for case in record.cases if case.sounds))
    paths = []
    for label in labels:
        rows: dict[str, dict[str, Tensor]] = {}
        for contact in stored_contacts(record):
            files = {outcome.method: outcome.sounds for case, outcome in contact.made if case.label == label}
            if files:
                sound = StoredSound.read(folder / contact.recorded)
                made = {
                    method: StoredSound.read(folder / sounds[contact.name]).samples for method, sounds in files.items()
                }
                rows[contact.name] = {_RECORDED: sound.samples, **made}
        if not rows:
            continue
        methods = list(dict.fromkeys(method for row in rows.values() for method in row))
        title = f"{record.identifier}: {label}"
        figure = draw_method_spectrograms(
            rows, methods, sample_rate=sound.sample_rate, highest=0.5 * record.sample_rate, title=title
        )
        name = record.identifier if len(labels) == 1 else f"{record.identifier} {file_word(label)}"
        paths.append(folder / FIGURES / f"{name}.png")
        save_picture(figure, paths[-1])
    return paths


def _write_maps(record: ObjectRecord, folder: Path) -> list[Path]:
    paths = []
    for outcome in record.outcomes:
        for recording, file in outcome.maps.items():
            found, truth = read_map(folder / file)
            title = f"{record.identifier}: {recording} located by {outcome.method}"
            # The file's name has the row, which tells recordings of one case apart.
            paths.append(folder / FIGURES / f"{record.identifier} {Path(file).stem}.png")
            save_picture(draw_contact(found, title=title, truth=truth), paths[-1])
    return paths


def _write_text(path: Path, text: str) -> None:
    write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=EvaluationError)
