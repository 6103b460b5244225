"""The content of a report, as titles, paragraphs and tables; and as Markdown."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from jinja2 import Environment, PackageLoader, select_autoescape

from avmsf._utils.text import counted
from avmsf.evaluation.protocols import BASELINE, COMPUTATION, PROTOCOLS, PUBLISHED, published_ratios
from avmsf.evaluation.registry import kind_of, title_of
from avmsf.evaluation.results import ObjectRecord
from avmsf.evaluation.summary import (
    RISING,
    Mean,
    Table,
    failures_of,
    figures_of,
    labels_of,
    means,
    ratios,
    times_of,
)

HEADINGS = {
    "l1": "L1",
    "l1_log": "L1-log",
    "envelope": "ENV",
    "cdpam": "CDPAM",
    "relative_stft": "relative STFT",
    "mac": "MAC",
    "gain_error": "gain error",
    "rmed": "RMED",
    "rmed_posterior": "RMED, posterior",
    "found": "energy of found modes",
}
"""Headings of metrics; others have their names."""
WARNING = (
    "The paper describes its metrics in words only. The convention used here is inferred from its rows for white "
    "noise. Compare ratios to KNN with the paper's, not absolute values."
)
_DASH = "–"


@dataclass(frozen=True)
class Grid:
    """A table of text; the first column names the rows."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    """Rows and columns of the best cells of each column."""


@dataclass(frozen=True)
class Section:
    """One part of a report."""

    title: str
    words: tuple[str, ...] = ()
    """Paragraphs before the table."""
    grid: Grid | None = None
    remarks: tuple[str, ...] = ()
    """Paragraphs after it."""


def sections(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    *,
    missing: Mapping[str, Sequence[str]] | None = None,
) -> list[Section]:
    """Return all parts of the report on these results, and which are missing: methods by object."""
    protocol, dataset = str(identity["protocol"]), str(identity["dataset"])
    order = list(identity["methods"])
    labels = labels_of(records)
    tables = {label: _ordered(figures_of(records, label), order) for label in labels}
    main = tables[labels[0]] if labels else {}
    shown = _metrics(main, protocol)
    parts = [_opening(records, identity, labels, missing or {})]
    if main:
        parts.append(_main_table(main, shown, protocol, dataset, labels))
        if any(BASELINE in methods for methods in main.values()):
            parts.append(_ratio_table(main, shown, protocol, dataset))
        if len(labels) > 1:
            parts += [_case_table(metric, tables, protocol, dataset) for metric in shown]
    parts.append(_times(records, order, protocol, dataset))
    parts.append(_failures(records))
    return parts


def figure(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash for None or NaN."""
    if value is None or not math.isfinite(value):
        return _DASH
    if value == 0 or not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def _opening(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    labels: Sequence[str],
    missing: Mapping[str, Sequence[str]],
) -> Section:
    protocol = PROTOCOLS.get(str(identity["protocol"]))
    about = f"{protocol.summary} " if protocol else ""
    trained = [len(case.train) for record in records for case in record.cases if case.label in labels[:1]]
    tested = sum(sum(len(case.test) for case in record.cases if case.label in labels[:1]) for record in records)
    return Section(
        f"{identity['protocol']} on {identity['dataset']}",
        (
            *([_incomplete(missing, {record.identifier for record in records})] if missing else []),
            f"{about}Objects: {len(records)}; training recordings of each: {_span(trained)}; "
            f"test recordings in total: {tested}"
            f"{f' ({labels[0]})' if len(labels) > 1 else ''}; avmsf {identity['version']}, seed {identity['seed']}.",
            "Values are means over an object's test recordings (CDPAM: over `cdpam_contacts` of them, 0 for all), then "
            "over objects, ± the standard error over objects. RMED is the distance between the located and the true "
            "contact relative to the diagonal of the object, by cosine distance; methods that cannot locate count as a "
            "random point. Lower is better, except for MAC and the energy of found modes. L1, L1-log and ENV follow "
            "the convention `paper` of docs/conventions.md; relative STFT does not depend on unit and level. With the "
            "level full-scale, an object's sounds are multiplied by one factor that brings its loudest recording to a "
            "peak of one.",
            WARNING,
            f"Settings of metrics: {_words(identity['metrics'])}. Of modes: {_words(identity['modes'])}.",
        ),
    )


def _words(settings: Mapping[str, Any]) -> str:
    """Return plain values in words, those of nested settings in parentheses."""
    return ", ".join(
        f"{name} ({_words(value)})" if isinstance(value, Mapping) else f"{name} {value}"
        for name, value in settings.items()
    )


def _incomplete(missing: Mapping[str, Sequence[str]], begun: Collection[str]) -> str:
    """Return the sentence on results that are not computed yet: methods are named only of objects that are begun."""
    listed = ", ".join(f"{name} ({', '.join(methods)})" if name in begun else name for name, methods in missing.items())
    objects = counted(len(missing), "object")
    return f"Incomplete: results of {objects} are missing: {listed}. Run the same command again to compute them."


def _span(counts: Sequence[int]) -> str:
    """Return a number, or the least and the largest of several."""
    least, most = min(counts, default=0), max(counts, default=0)
    return f"{least}" if least == most else f"{least} to {most}"


def _main_table(main: Table, shown: Sequence[str], protocol: str, dataset: str, labels: Sequence[str]) -> Section:
    found = means(main)
    rows = [
        (method, *(_mean(figures.get(metric)) for metric in shown), _count(figures))
        for method, figures in found.items()
    ]
    paper = PUBLISHED.get((dataset, protocol), ())
    rows += [
        (f"paper: {row.title}", *(figure(row.figures.get(metric)) for metric in shown), _DASH)
        for row in paper
        if row.label in (None, labels[0])
    ]
    remark = (
        f"Rows that begin with “paper:” are the paper's values on {dataset}. {WARNING}"
        if paper
        else f"The paper has no values of this experiment on {dataset}."
    )
    grid = Grid(("method", *_headings(shown), "objects"), tuple(rows), _best(main, found, shown))
    titles = "; ".join(f"{method}: {title}" for method in found if (title := title_of(method)) is not None)
    remarks = (*_of_fewer(main), remark, *([f"{titles}."] if titles else []))
    return Section("All methods" + (f": {labels[0]}" if len(labels) > 1 else ""), (), grid, remarks)


def _ratio_table(main: Table, shown: Sequence[str], protocol: str, dataset: str) -> Section:
    found = ratios(main)
    falling = [metric for metric in shown if any(metric in figures for figures in found.values())]
    rows = [(method, *(figure(found[method].get(metric)) for metric in falling)) for method in found]
    for source, methods in published_ratios(protocol).items():
        if (dataset, protocol) in PUBLISHED and not dataset.startswith(source):
            continue
        rows += [
            (f"paper, {source}: {method}", *(figure(figures.get(metric)) for metric in falling))
            for method, figures in methods.items()
            if method in map(kind_of, found)
        ]
    return Section(
        f"Ratio to {BASELINE}",
        (
            "Below 1 is better than the mean of the three nearest recordings. Our values are geometric means of the "
            "objects' ratios; the paper's are ratios of its means, since it gives no ratios, from its main tables "
            "where its table of this experiment has no KNN.",
        ),
        Grid(("method", *_headings(falling)), tuple(rows)),
    )


def _case_table(metric: str, tables: Mapping[str, Table], protocol: str, dataset: str) -> Section:
    found = {label: means(table) for label, table in tables.items()}
    methods = list(dict.fromkeys(method for each in found.values() for method in each))
    rows = [(method, *(_mean(found[label].get(method, {}).get(metric)) for label in tables)) for method in methods]
    paper = PUBLISHED.get((dataset, protocol), ())
    for title in dict.fromkeys(row.title for row in paper):
        own = {row.label: row.figures.get(metric) for row in paper if row.title == title}
        if any(own.get(label) is not None for label in tables):
            rows.append((f"paper: {title}", *(figure(own.get(label)) for label in tables)))
    return Section(f"{HEADINGS.get(metric, metric)} by case", (), Grid(("method", *tables), tuple(rows)))


def _times(records: Sequence[ObjectRecord], order: Sequence[str], protocol: str, dataset: str) -> Section:
    times = times_of(records).values()
    rows = []
    for method in order:
        found = [each["methods"][method] for each in times if method in each["methods"]]
        if found:
            rows.append((method, *(figure(fmean(each[name] for each in found)) for name in ("fit", "render"))))
    if times:
        rows.append(("shared: modes and features", figure(fmean(each["shared"] for each in times)), _DASH))
    words = "Seconds on one thread, mean over objects, sum over a protocol's cases, without the computation of metrics."
    if (dataset, protocol) in PUBLISHED:
        rows += [(f"paper: {title}", *map(figure, seconds)) for title, seconds in COMPUTATION.items()]
        words += " Rows that begin with “paper:” are the paper's: one training and one sound on an A5000 GPU."
    return Section("Time per object", (words,), Grid(("method", "fit", "render the test contacts"), tuple(rows)))


def _failures(records: Sequence[ObjectRecord]) -> Section:
    failures = failures_of(records)
    if not failures:
        return Section("Failures", ("None.",))
    rows = tuple(
        (str(each["object"]), each["case"] or "all", each["method"] or "all", str(each["failure"])) for each in failures
    )
    return Section("Failures", (), Grid(("object", "case", "method", "reason"), rows))


def _ordered(table: Table, order: Sequence[str]) -> Table:
    """Return the table with its methods in the requested order."""
    return {
        identifier: {method: figures[method] for method in order if method in figures}
        for identifier, figures in table.items()
    }


def _metrics(table: Table, protocol: str) -> tuple[str, ...]:
    """Return the protocol's columns that have values."""
    columns = PROTOCOLS[protocol].metrics if protocol in PROTOCOLS else tuple(HEADINGS)
    known = {metric for figures in table.values() for values in figures.values() for metric in values}
    return tuple(metric for metric in columns if metric in known)


def _headings(metrics: Sequence[str]) -> tuple[str, ...]:
    return tuple(HEADINGS.get(metric, metric.replace("_", " ")) for metric in metrics)


def _mean(mean: Mean | None) -> str:
    if mean is None:
        return _DASH
    text = figure(mean.mean)
    return text if mean.standard_error is None else f"{text} ± {figure(mean.standard_error, 2)}"


def _count(figures: Mapping[str, Mean]) -> str:
    return str(max((each.objects for each in figures.values()), default=0))


def _best(table: Table, found: Mapping[str, Mapping[str, Mean]], shown: Sequence[str]) -> frozenset[tuple[int, int]]:
    """Return the best cells of each metric's column, among the methods that have it of all objects that have it."""
    best = set()
    for column, metric in enumerate(shown, 1):
        total = sum(any(metric in values for values in figures.values()) for figures in table.values())
        means_of = {row: each[metric] for row, each in enumerate(found.values()) if metric in each}
        complete = [(mean.mean, row) for row, mean in means_of.items() if mean.objects == total]
        if complete:
            best.add((max(complete, key=lambda pair: pair[0])[1] if metric in RISING else min(complete)[1], column))
    return frozenset(best)


def _of_fewer(table: Table) -> tuple[str, ...]:
    """Return the sentence on methods without results of some objects; nothing where there are none."""
    methods = dict.fromkeys(method for figures in table.values() for method in figures)
    fewer = [method for method in methods if any(method not in figures for figures in table.values())]
    if not fewer:
        return ()
    return (
        f"Not of all {len(table)} objects: {', '.join(fewer)}. Their means are of other objects than those of the "
        "other rows, and not marked as best; ratios are of the same objects.",
    )


def render(template: str, **values: Any) -> str:
    """Return a filled template of the package."""
    loader, escape = PackageLoader("avmsf.evaluation", ""), select_autoescape(("html.jinja",))
    environment = Environment(loader=loader, autoescape=escape, trim_blocks=True)
    environment.filters["markdown"] = _escaped
    return environment.get_template(template).render(**values)


def markdown(parts: Sequence[Section]) -> str:
    """Return the parts as one text: the first one's title above all, each table in pipes."""
    return render("report.md.jinja", parts=parts).rstrip() + "\n"


def _escaped(words: str) -> str:
    return words.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("<", "&lt;")
