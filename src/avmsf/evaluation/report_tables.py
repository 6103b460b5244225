"""The content of a report: titles, paragraphs and tables of text."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any

from avmsf._utils.text import counted, format_number
from avmsf.evaluation.published import COMPUTATION, PUBLISHED, published_ratios
from avmsf.evaluation.registry import BASELINE, METHODS, METRICS, PROTOCOLS, kind_of
from avmsf.evaluation.results import ObjectRecord
from avmsf.evaluation.summary import Mean, Values, failures_of, is_rising, labels_of, means, ratios, times_of, values_of

WARNING = (
    "The paper describes its metrics in words only. The convention used here is inferred from its rows for white "
    "noise. Compare ratios to KNN with the paper's, not absolute values."
)
_DASH = format_number(None)


@dataclass(frozen=True)
class Section:
    """One part of a report: paragraphs, a table, and paragraphs below it."""

    title: str
    paragraphs: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    """Headings of the table, whose first column names the rows; empty without a table."""
    rows: tuple[tuple[str, ...], ...] = ()
    best: frozenset[tuple[int, int]] = frozenset()
    """Rows and columns of the best cells of each column."""
    remarks: tuple[str, ...] = ()


def sections(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    *,
    missing: Mapping[str, Sequence[str]] | None = None,
) -> list[Section]:
    """Return all parts of the report on these results, and which are missing: methods by object."""
    report = _Report(records, identity, missing or {})
    parts = [report.opening()]
    if report.main:
        parts.append(report.main_table())
        if any(BASELINE in methods for methods in report.main.values()):
            parts.append(report.ratio_table())
        if len(report.tables) > 1:
            parts += [report.case_table(metric) for metric in report.shown]
    return [*parts, report.times(), report.failures()]


@dataclass(frozen=True)
class _Report:
    records: Sequence[ObjectRecord]
    identity: Mapping[str, Any]
    missing: Mapping[str, Sequence[str]]

    @cached_property
    def tables(self) -> dict[str, Values]:
        """Values of each experiment by its label, the main one first, with the methods in the requested order."""
        order = list(self.identity["methods"])
        return {
            label: {
                name: {method: values[method] for method in order if method in values}
                for name, values in values_of(self.records, label).items()
            }
            for label in labels_of(self.records)
        }

    @property
    def label(self) -> str | None:
        return next(iter(self.tables), None)

    @property
    def main(self) -> Values:
        return next(iter(self.tables.values()), {})

    @property
    def shown(self) -> list[str]:
        """Metrics with a column."""
        known = {metric for methods in self.main.values() for values in methods.values() for metric in values}
        return [metric for metric, entry in METRICS.items() if metric in known and entry.heading]

    @property
    def experiment(self) -> tuple[str, str]:
        return str(self.identity["dataset"]), str(self.identity["protocol"])

    def opening(self) -> Section:
        dataset, name = self.experiment
        about = f"{PROTOCOLS[name].title} " if name in PROTOCOLS else ""
        cases = [case for record in self.records for case in record.cases if case.label == self.label]
        several = f" ({self.label})" if len(self.tables) > 1 else ""
        settings = self.identity["metrics"], self.identity["modes"]
        return Section(
            f"{name} on {dataset}",
            (
                *self._incomplete(),
                f"{about}Objects: {len(self.records)}; training recordings of each: "
                f"{_span([len(case.train) for case in cases])}; test recordings in total: "
                f"{sum(len(case.test) for case in cases)}{several}; avmsf {self.identity['version']}, seed "
                f"{self.identity['seed']}.",
                "Values are means over an object's test recordings (CDPAM: over `cdpam_contacts` of them, 0 for all), "
                "then over objects, ± the standard error over objects. RMED is the distance between the located and "
                "the true contact relative to the diagonal of the object, by cosine distance; methods that cannot "
                "locate count as a random point. Lower is better, except for MAC. L1, "
                "L1-log and ENV follow the convention `paper` of docs/conventions.md; relative STFT does not depend on "
                "unit and level. With the level full-scale, an object's sounds are multiplied by one factor that "
                "brings its loudest recording to a peak of one.",
                WARNING,
                "Settings of metrics: {}. Of modes: {}.".format(*map(_listed, settings)),
            ),
        )

    def _incomplete(self) -> list[str]:
        """Return the sentence on missing results: methods are named only of objects that are begun."""
        begun = {record.identifier for record in self.records}
        listed = [f"{name} ({', '.join(each)})" if name in begun else name for name, each in self.missing.items()]
        objects, advice = counted(len(listed), "object"), "Run the same command again to compute them."
        return [f"Incomplete: results of {objects} are missing: {', '.join(listed)}. {advice}"] if listed else []

    def main_table(self) -> Section:
        found, (dataset, _) = means(self.main), self.experiment
        rows = [
            (
                method,
                *(_mean(values.get(metric)) for metric in self.shown),
                str(max((each.objects for each in values.values()), default=0)),
            )
            for method, values in found.items()
        ]
        paper = [row for row in PUBLISHED.get(self.experiment, ()) if row.label in (None, self.label)]
        rows += [(*_row(f"paper: {row.title}", row.values, self.shown), _DASH) for row in paper]
        remark = f"The paper has no values of this experiment on {dataset}."
        if self.experiment in PUBLISHED:
            remark = f"Rows that begin with “paper:” are the paper's values on {dataset}. {WARNING}"
        titles = "; ".join(f"{each}: {METHODS[kind_of(each)].title}" for each in found if kind_of(each) in METHODS)
        return Section(
            "All methods" + (f": {self.label}" if len(self.tables) > 1 else ""),
            (),
            ("method", *(METRICS[metric].heading for metric in self.shown), "objects"),
            tuple(rows),
            self._best(found),
            (*self._of_fewer(), remark, *([f"{titles}."] if titles else [])),
        )

    def ratio_table(self) -> Section:
        found, (dataset, protocol) = ratios(self.main), self.experiment
        falling = [metric for metric in self.shown if any(metric in values for values in found.values())]
        rows = [_row(method, values, falling) for method, values in found.items()]
        for source, methods in published_ratios(protocol).items():
            if self.experiment not in PUBLISHED or dataset.startswith(source):
                known = [method for method in methods if method in map(kind_of, found)]
                rows += [_row(f"paper, {source}: {method}", methods[method], falling) for method in known]
        text = (
            "Below 1 is better than the mean of the three nearest recordings. Our values are geometric means of "
            "the objects' ratios; the paper's are ratios of its means, since it gives no ratios, from its main "
            "tables where its table of this experiment has no KNN."
        )
        columns = ("method", *(METRICS[metric].heading for metric in falling))
        return Section(f"Ratio to {BASELINE}", (text,), columns, tuple(rows))

    def case_table(self, metric: str) -> Section:
        found = {label: means(table) for label, table in self.tables.items()}
        methods = dict.fromkeys(method for each in found.values() for method in each)
        rows = [(method, *(_mean(each.get(method, {}).get(metric)) for each in found.values())) for method in methods]
        paper = PUBLISHED.get(self.experiment, ())
        for title in dict.fromkeys(row.title for row in paper):
            own = {row.label: row.values[metric] for row in paper if row.title == title and metric in row.values}
            if own.keys() & found.keys():
                rows.append(_row(f"paper: {title}", own, found))
        return Section(f"{METRICS[metric].heading} by case", (), ("method", *found), tuple(rows))

    def times(self) -> Section:
        times, rows, steps = list(times_of(self.records).values()), [], ("fit", "render")
        for method in self.identity["methods"]:
            found = [each["methods"][method] for each in times if method in each["methods"]]
            if found:
                rows.append(_row(method, {step: fmean(each[step] for each in found) for step in steps}, steps))
        if times:
            rows.append(("shared: modes and features", format_number(fmean(each["shared"] for each in times)), _DASH))
        text = (
            "Seconds on one thread, mean over objects, sum over a protocol's cases, without the computation of metrics."
        )
        if self.experiment in PUBLISHED:
            rows += [(f"paper: {title}", *map(format_number, seconds)) for title, seconds in COMPUTATION.items()]
            text += " Rows that begin with “paper:” are the paper's: one training and one sound on an A5000 GPU."
        return Section("Time per object", (text,), ("method", "fit", "render the test contacts"), tuple(rows))

    def failures(self) -> Section:
        failures, columns = failures_of(self.records), ("object", "case", "method", "failure")
        if not failures:
            return Section("Failures", ("None.",))
        rows = tuple(tuple(each[column] or "all" for column in columns) for each in failures)
        return Section("Failures", (), (*columns[:-1], "reason"), rows)

    def _best(self, found: Mapping[str, Mapping[str, Mean]]) -> frozenset[tuple[int, int]]:
        """Return the best cells of each metric's column, among the methods that have it of all objects that have it."""
        best = set()
        for column, metric in enumerate(self.shown, 1):
            total = sum(any(metric in values for values in methods.values()) for methods in self.main.values())
            known = {row: values[metric] for row, values in enumerate(found.values()) if metric in values}
            complete = {row: mean.mean for row, mean in known.items() if mean.objects == total}
            if complete:
                best.add(((max if is_rising(metric) else min)(complete, key=complete.__getitem__), column))
        return frozenset(best)

    def _of_fewer(self) -> list[str]:
        """Return the sentence on methods without results of some objects."""
        methods = dict.fromkeys(method for values in self.main.values() for method in values)
        fewer = [method for method in methods if any(method not in values for values in self.main.values())]
        text = (
            f"Not of all {len(self.main)} objects: {', '.join(fewer)}. Their means are of other objects than those of "
            "the other rows, and not marked as best; ratios are of the same objects."
        )
        return [text] if fewer else []


def _row(name: str, values: Mapping[Any, float], columns: Iterable[str]) -> tuple[str, ...]:
    return name, *(format_number(values.get(column)) for column in columns)


def _listed(settings: Mapping[str, Any]) -> str:
    """Return plain values as text, those of nested settings in parentheses."""
    return ", ".join(
        f"{name} ({_listed(value)})" if isinstance(value, Mapping) else f"{name} {value}"
        for name, value in settings.items()
    )


def _span(counts: Sequence[int]) -> str:
    """Return a number, or the least and the largest of several."""
    least, most = min(counts, default=0), max(counts, default=0)
    return f"{least}" if least == most else f"{least} to {most}"


def _mean(mean: Mean | None) -> str:
    if mean is None:
        return _DASH
    text = format_number(mean.mean)
    return text if mean.standard_error is None else f"{text} ± {format_number(mean.standard_error, 2)}"
