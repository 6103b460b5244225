"""The files of a results folder: summary, times, and one report as Markdown and as a page that stands on its own."""

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, product, repeat, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure
from matplotlib.image import imsave
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.text import format_number, read_json
from avmsf.capture.audio import Recording, read_recording
from avmsf.errors import EvaluationError
from avmsf.evaluation.localization import read_map
from avmsf.evaluation.registry import METRICS
from avmsf.evaluation.results import (
    RECORDED,
    SPACES,
    CaseRecord,
    ObjectRecord,
    Outcome,
    ResultsFolder,
    file_word,
    write_json,
)
from avmsf.evaluation.splits import evenly_spaced
from avmsf.evaluation.tables import Section, missing_of, sections, summarize, times_of
from avmsf.export.web import report_directives, with_policy
from avmsf.plotting.edits import Curve, Move, draw_clap_curves, draw_embedding
from avmsf.plotting.pictures import RANGE_DB, draw_spectrograms, log_spectrogram, save_picture
from avmsf.plotting.style import SEQUENTIAL
from avmsf.plotting.uncertainty import draw_contact

SUMMARY, TIMES, TABLES, PAGE = "summary.json", "times.json", "report.md", "report.html"
"""The files next to `protocol.json` and the folder `objects`."""
FIGURES = "figures"
"""Folder of the spectrograms, one file for each object, or for each object and case, and of the heat maps."""
MAX_PAGE_CHARACTERS = 13_000_000
"""Of the page's pictures and sounds; further contacts are omitted."""
MAX_PAGE_OBJECTS = 4
"""Objects with sounds on the page, evenly spaced over all."""
_LOWEST_HZ = 60.0
"""Lower edge of the page's pictures, which are logarithmic in frequency above it."""


def write_summary(
    results: ResultsFolder, *, subsets: Mapping[str, frozenset[str]], wanted: Mapping[str, Sequence[str]] | None = None
) -> dict[str, Any]:
    """Write `summary.json`, `times.json` and `report.md` of the folder's results, and return the summary.

    `wanted` are the methods of each object that the evaluation is of; those without results yet are named as missing.
    """
    records, identity = results.records(), results.identity()
    missing = missing_of(records, wanted or {})
    summary = summarize(records, identity, subsets=subsets, missing=missing)
    write_json(results.path / SUMMARY, summary)
    write_json(results.path / TIMES, times_of(records))
    write_whole(results.path / TABLES, markdown(sections(records, identity, missing=missing)), raising=EvaluationError)
    return summary


def write_page(results: ResultsFolder) -> list[Section]:
    """Write `report.html`, and return its parts. Raises CaptureError where a stored sound is missing."""
    records = results.records()
    parts = sections(records, results.identity())
    opening, *others = parts
    values = {"listening": _listening(records, results.path), "range_db": f"{RANGE_DB:g}", "is_text": _is_text}
    whole = _render("report.html.jinja", opening=opening, parts=others, **values)
    write_whole(results.path / PAGE, with_policy(whole, report_directives(whole)), raising=EvaluationError)
    return parts


def markdown(parts: Sequence[Section]) -> str:
    """Return the parts as one text: the first one's title above all, each table in pipes."""
    return _render("report.md.jinja", parts=parts).rstrip() + "\n"


def _render(template: str, **values: Any) -> str:
    loader, escape = PackageLoader("avmsf.evaluation", ""), select_autoescape(("html.jinja",))
    environment = Environment(loader=loader, autoescape=escape, trim_blocks=True)
    environment.filters["markdown"] = _escaped
    return environment.get_template(template).render(**values)


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")


def _is_text(cell: str) -> bool:
    return any(mark.isalpha() and mark != "e" for mark in cell)


_StoredContact = tuple[str, str, list[tuple[CaseRecord, Outcome]]]
"""A test contact with stored sounds: the recording's name and file, and the predictions of all methods."""


def stored_contacts(record: ObjectRecord) -> Iterator[_StoredContact]:
    """Yield an object's contacts with stored sounds."""
    files = {name: file for case in reversed(record.cases) for name, file in case.sounds.items()}
    pairs = [(case, each) for case in record.cases for each in record.outcomes if each.case == case.key]
    for name, file in files.items():
        yield name, file, [pair for pair in pairs if name in pair[1].sounds]


_Card = dict[str, str]
"""One sound on the page: its `title`, its `caption`, and the addresses of its `picture` and its `sound`."""


def _listening(records: Sequence[ObjectRecord], folder: Path) -> dict[str, list[tuple[str, list[_Card]]]]:
    """Return contacts' names and sounds by the titles of their objects, as many as fit: one of each object first."""
    stored = [record for record in records if any(case.sounds for case in record.cases)]
    shown = [stored[row] for row in evenly_spaced(len(stored), MAX_PAGE_OBJECTS)]
    found: dict[str, list[tuple[str, list[_Card]]]] = {}
    size = 0
    contacts = zip_longest(*(zip(repeat(record), stored_contacts(record)) for record in shown))
    for facts, contact in filter(None, chain.from_iterable(contacts)):
        cards = list(_cards(contact, folder))
        size += sum(len(card["picture"]) + len(card["sound"]) for card in cards)
        if size > MAX_PAGE_CHARACTERS:
            break
        label = facts.name if facts.name in ("", facts.identifier) else f"{facts.identifier}: {facts.name}"
        title = ", ".join(filter(None, (label or facts.identifier, facts.material)))
        found.setdefault(title, []).append((contact[0], cards))
    return found


def _cards(contact: _StoredContact, folder: Path) -> Iterator[_Card]:
    name, file, made = contact
    recorded = read_recording(folder / file)
    loudest = float(picture_levels(recorded).max())

    def card(title: str, caption: str, path: Path) -> _Card:
        picture = draw_spectrogram(picture_levels(read_recording(path)), loudest=loudest)
        sound = _address("audio/flac", path.read_bytes())
        return {"title": title, "caption": caption, "picture": picture, "sound": sound}

    band = "{:.0f} Hz to {:.0f} Hz".format(*_band(recorded.sample_rate))
    yield card(RECORDED, f"{recorded.duration:.2g} s, {band}", folder / file)
    several = len({case.label for case, _ in made}) > 1
    for case, outcome in made:
        row = case.test.index(name)
        scores = [
            f"{entry.heading} {format_number(outcome.values[metric][row])}"
            for metric, entry in METRICS.items()
            if entry.function is not None and metric in outcome.values
        ]
        title = f"{outcome.method}, {case.label}" if several else outcome.method
        yield card(title, ", ".join(scores), folder / outcome.sounds[name])


def _band(sample_rate: float) -> tuple[float, float]:
    """Return the lowest and the highest frequency of the page's pictures, Hz."""
    return min(_LOWEST_HZ, sample_rate / 100), sample_rate / 2


def picture_levels(sound: Recording) -> Float64[Tensor, "height width"]:
    """Return the levels of a sound's picture, dB, from the lowest frequency up to half the sample rate."""
    (lowest, highest), samples, rate = _band(sound.sample_rate), torch.tensor(sound.channels[0]), sound.sample_rate
    return log_spectrogram(samples, sample_rate=rate, lowest=lowest, highest=highest, width=240, height=120)


def draw_spectrogram(levels: Float64[Tensor, "height width"], *, loudest: float) -> str:
    """Return the address of a picture of levels: time to the right, frequency upwards on a logarithmic scale.

    Colors span 80 dB below `loudest`, dB, the brightest point of the recording it is compared with.
    """
    memory = io.BytesIO()
    imsave(memory, levels.numpy(), cmap=SEQUENTIAL, vmin=loudest - RANGE_DB, vmax=loudest, origin="lower", format="png")
    return _address("image/png", memory.getvalue())


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def write_figures(results: ResultsFolder) -> list[Path]:
    """Draw what is stored, and return the files.

    Edits are drawn as moves in the embedding of their metric, one PNG for each two materials, and as CLAP scores over
    the steps. Sounds are drawn as spectrograms, the recording next to all methods, one PNG for each object and each
    label of its cases; localized contacts as heat maps with the true contact marked, one PNG for each field and
    recording. Raises EvaluationError where a stored map is missing, CaptureError where a sound is.
    """
    drawn, records = (_write_spectrograms, _write_maps), results.records()
    paths = [path for record in records for draw in drawn for path in draw(record, results.path)]
    return [*paths, *_write_edits(records, results.path)]


def _write_edits(records: Sequence[ObjectRecord], folder: Path) -> Iterator[Path]:
    moved: dict[tuple[str, str], list[tuple[str, Any, Any]]] = {}
    curves: dict[str, list[Curve]] = {}
    for record in records:
        outcomes = [each for each in record.outcomes if "places" in each.report]
        # Of this object alone: others of its material have cases of the same keys.
        before = {each.case: each.report["places"] for each in outcomes if each.method == "unedited"}
        for each in outcomes:
            if each.method != "unedited" and each.case in before:
                move = each.method, before[each.case], each.report["places"]
                moved.setdefault((each.report["source"], each.report["target"]), []).append(move)
            if each.report.get("clap"):
                curves.setdefault(each.method, []).append([(step, score) for step, score in each.report["clap"]])
    spaces = read_json(folder / SPACES) if moved else {}
    for (metric, space), ((source, target), edits) in product(spaces.items(), moved.items()):
        moves: dict[str, list[Move]] = {}
        for method, old, new in edits:
            moves.setdefault(method, []).append((old[metric], new[metric]))
        title = f"{source} to {target}, {METRICS[metric].heading} of {len(space['names'])} objects"
        figure = draw_embedding(np.array(space["embedding"]), space["materials"], moves, target=target, title=title)
        yield _write_figure(figure, folder, f"{metric} {source} to {target}")
    if curves:
        figure = draw_clap_curves(curves, title="CLAP score of the previews and the prompt")
        yield _write_figure(figure, folder, "clap")


def _write_spectrograms(record: ObjectRecord, folder: Path) -> Iterator[Path]:
    labels = list(dict.fromkeys(case.label for case in record.cases if case.sounds))
    for label in labels:
        rows: dict[str, dict[str, Tensor]] = {}
        for recording, recorded, predicted in stored_contacts(record):
            made = {each.method: each.sounds[recording] for case, each in predicted if case.label == label}
            if made:
                files = {RECORDED: recorded, **made}
                sounds = {name: read_recording(folder / file) for name, file in files.items()}
                rate = sounds[RECORDED].sample_rate
                rows[recording] = {name: torch.tensor(sound.channels[0]) for name, sound in sounds.items()}
        if rows:
            methods = list(dict.fromkeys(method for row in rows.values() for method in row))
            name = record.identifier if len(labels) == 1 else f"{record.identifier} {file_word(label)}"
            highest, title = 0.5 * record.sample_rate, f"{record.identifier}: {label}"
            figure = draw_spectrograms(rows, methods, sample_rate=rate, highest=highest, title=title)
            yield _write_figure(figure, folder, name)


def _write_maps(record: ObjectRecord, folder: Path) -> Iterator[Path]:
    for outcome in record.outcomes:
        for recording, file in outcome.maps.items():
            found, truth = read_map(folder / file)
            title = f"{record.identifier}: {recording} located by {outcome.method}"
            # The file's name has the row, which tells recordings of one case apart.
            yield _write_figure(
                draw_contact(found, title=title, truth=truth), folder, f"{record.identifier} {Path(file).stem}"
            )


def _write_figure(figure: Figure, folder: Path, name: str) -> Path:
    path = folder / FIGURES / f"{name}.png"
    save_picture(figure, path)
    return path
