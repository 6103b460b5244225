"""Tables of stored values: means over contacts, then over objects; ratios to the baseline; and the report's text.

Every object has the same weight. A method's mean is over the objects that it has values of; ratios are over those that
the baseline has values above 0 of too, paired by object. The ratio is the geometric mean of the objects' ratios, so
that it does not depend on level and swapping the methods inverts it; the ratio of the means, the only one that the
paper's tables allow, is given too.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, geometric_mean, median, stdev
from typing import Any

from avmsf._utils.text import counted, format_number
from avmsf.evaluation.published import COMPUTATION, PUBLISHED, published_ratios
from avmsf.evaluation.registry import BASELINE, METHODS, METRICS, PROTOCOLS, kind_of
from avmsf.evaluation.results import ObjectRecord

WARNING = (
    "The paper describes its metrics in words only. The convention used here is inferred from its rows for white "
    "noise. Compare ratios to KNN with the paper's, not absolute values."
)
_DASH = format_number(None)
CHOSEN_ON_TEST = "paper, damping chosen on test contacts"
"""The likely reading of the paper's choice of its dampings: of both forms, for each object that of lower ENV at its
test contacts. What has seen the contacts that it is tested at is never marked as best."""
DAMPING_FORMS = ("paper", "paper-per-contact")
"""The methods that it is a choice of: where both have values, its row is shown."""
Values = Mapping[str, Mapping[str, Mapping[str, float]]]
"""By method, metric and object."""


def _is_rising(metric: str) -> bool:
    """Whether more of a metric is better; all others are errors, and only they have ratios."""
    return metric in METRICS and METRICS[metric].rising


def labels_of(records: Iterable[ObjectRecord]) -> tuple[str, ...]:
    """Return the experiments' labels, in the protocol's order; the first is the main one."""
    found = (tuple(dict.fromkeys(case.label for case in record.cases)) for record in records)
    return max(found, key=len, default=())


def values_of(
    records: Iterable[ObjectRecord], label: str, average: Callable[[Sequence[float]], float] = fmean
) -> dict[str, dict[str, dict[str, float]]]:
    """Return figures in one experiment by method, metric and object: means over its contacts, or other averages.

    A method that failed in any part of an object's experiment has none of it. `CHOSEN_ON_TEST` counts as a method.
    """
    table: dict[str, dict[str, dict[str, float]]] = {}
    for record in records:
        keys = {case.key for case in record.cases if case.label == label}
        pooled: dict[str, dict[str, list[float]]] = {}
        for method in dict.fromkeys(each.method for each in record.outcomes):
            outcomes = [each for each in record.outcomes if each.method == method and each.case in keys]
            if len(outcomes) < len(keys) or any(each.failure is not None for each in outcomes):
                continue
            found = pooled.setdefault(method, {})
            for each in outcomes:
                for metric, values in (*each.values.items(), *((name, (one,)) for name, one in each.figures.items())):
                    found.setdefault(metric, []).extend(value for value in values if value is not None)
        forms = [pooled[form] for form in DAMPING_FORMS if pooled.get(form, {}).get("envelope")]
        if len(forms) == len(DAMPING_FORMS):
            pooled[CHOSEN_ON_TEST] = min(forms, key=lambda found: fmean(found["envelope"]))
        for method, found in pooled.items():
            for metric, all_values in found.items():
                if all_values:
                    table.setdefault(method, {}).setdefault(metric, {})[record.identifier] = average(all_values)
    return table


def means(table: Values, statistic: Callable[[Sequence[float]], Any] = fmean) -> dict[str, dict[str, Any]]:
    """Return the means over objects, or another statistic of their values, by method and metric."""
    return {method: {name: statistic([*each.values()]) for name, each in row.items()} for method, row in table.items()}


def standard_error(values: Sequence[float]) -> float | None:
    """Return the standard error of a mean, as if the objects were a random sample; None for a single one."""
    return stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None


def _objects(*metrics: Mapping[str, Mapping[str, float]]) -> set[str]:
    """Return the objects that methods have values of."""
    return {identifier for each in metrics for values in each.values() for identifier in values}


def ratios(table: Values, *, of_means: bool = False) -> dict[str, dict[str, float]]:
    """Return the geometric means of the ratios to the baseline, object by object, or the ratios `of_means`."""
    known, found = table.get(BASELINE, {}), dict[str, dict[str, float]]()
    for method, metrics in table.items():
        for metric, values in metrics.items():
            others = known.get(metric, {})
            pairs = [(value, others[name]) for name, value in values.items() if others.get(name, 0.0) > 0]
            row = found.setdefault(method, {}) if pairs else {}
            if pairs and of_means and not _is_rising(metric):
                row[metric] = math.fsum(one for one, _ in pairs) / math.fsum(base for _, base in pairs)
            elif pairs and not _is_rising(metric):
                row[metric] = geometric_mean([one / base for one, base in pairs]) if min(pairs)[0] > 0 else 0.0
    return found


def summarize(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    *,
    subsets: Mapping[str, frozenset[str]] | None = None,
    missing: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return all figures as plain values, of which the same records always give the same.

    `methods`, `standard_errors`, `ratio_to_knn3` and the like are of the main experiment, `cases` of each; `medians`
    are over an object's contacts, and means of these over objects; `subsets` names groups of objects that have means
    of their own; `missing` are the results that are yet to be computed.
    """
    labels = labels_of(records)
    tables = {label: values_of(records, label) for label in labels}
    main = tables[labels[0]] if labels else {}
    parts = {
        name: values_of([each for each in records if each.identifier in members], labels[0])
        for name, members in (subsets or {}).items()
        if labels
    }
    return {
        **{key: identity.get(key) for key in ("protocol", "dataset", "version", "seed", "metrics")},
        "main_case": labels[0] if labels else None,
        "objects": len(records),
        "test_contacts": sum(
            len({name for case in each.cases if case.label in labels[:1] for name in case.test}) for each in records
        ),
        "methods": means(main),
        "standard_errors": means(main, standard_error),
        "medians": means(values_of(records, labels[0], median)) if labels else {},
        "counts": {method: max(map(len, metrics.values())) for method, metrics in main.items()},
        f"ratio_to_{BASELINE}": ratios(main),
        f"ratio_of_means_to_{BASELINE}": ratios(main, of_means=True),
        "cases": {label: means(table) for label, table in tables.items()},
        "subsets": {
            name: {"objects": len(_objects(*table.values())), "methods": means(table)}
            for name, table in parts.items()
            if table
        },
        "failures": failures_of(records),
        "missing": {name: list(methods) for name, methods in (missing or {}).items()},
    }


def missing_of(records: Iterable[ObjectRecord], wanted: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return, of the wanted methods of each object, those without an outcome in all of its cases.

    A failure is an outcome. Objects that lack nothing are left out.
    """
    known, missing = {record.identifier: record for record in records}, {}
    for name, methods in wanted.items():
        record = known.get(name, ObjectRecord(name))
        found, cases = {(each.case, each.method) for each in record.outcomes}, record.cases
        if record.failure is None:
            missing[name] = [
                each for each in methods if not cases or any((case.key, each) not in found for case in cases)
            ]
    return {name: methods for name, methods in missing.items() if methods}


def failures_of(records: Iterable[ObjectRecord]) -> list[dict[str, str | None]]:
    """Return the failures with their reasons, each in one line."""
    found: list[dict[str, str | None]] = []
    for record in records:
        order = {case.key: number for number, case in enumerate(record.cases)}
        outcomes = sorted(record.outcomes, key=lambda each: (order.get(each.case, len(order)), each.method))
        rows = [(None, None, record.failure), *((each.case, each.method, each.failure) for each in outcomes)]
        for case, method, failure in rows:
            if failure is not None:
                reason = failure.partition("\n")[0]
                found.append({"object": record.identifier, "case": case, "method": method, "failure": reason})
    return found


def times_of(records: Iterable[ObjectRecord]) -> dict[str, dict[str, Any]]:
    """Return each object's seconds: what methods share, and each method's to fit and to render all test contacts.

    A method has none of an object that it failed on or is not done with; objects that could not be read are left out.
    """
    times = {}
    for record in (each for each in records if each.cases):
        keys, methods = {case.key for case in record.cases}, dict[str, dict[str, float]]()
        for method in dict.fromkeys(each.method for each in record.outcomes):
            wanted = method, None
            done = [each for each in record.outcomes if (each.method, each.failure) == wanted and each.case in keys]
            if len(done) == len(keys):
                steps = {"fit": [each.fit_seconds for each in done], "render": [each.render_seconds for each in done]}
                methods[method] = {step: math.fsum(seconds) for step, seconds in steps.items()}
        shared = math.fsum(case.shared_seconds for case in record.cases)
        times[record.identifier] = {"shared": shared, "methods": methods}
    return times


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
    records: Sequence[ObjectRecord], identity: Mapping[str, Any], *, missing: Mapping[str, Sequence[str]] | None = None
) -> list[Section]:
    """Return all parts of the report on these results, and which are missing: methods by object."""
    report = _Report(records, identity, missing or {})
    parts = [report.opening()]
    if report.main:
        parts.append(report.main_table())
        if BASELINE in report.main:
            parts.append(report.ratio_table())
        parts.append(report.median_table())
        if len(report.tables) > 1:
            parts += [report.case_table(metric) for metric in report.shown]
    return [*parts, report.times(), report.failures()]


class _Report:
    """What the parts of a report have in common."""

    def __init__(
        self, records: Sequence[ObjectRecord], identity: Mapping[str, Any], missing: Mapping[str, Sequence[str]]
    ) -> None:
        self.records, self.identity, self.missing = records, identity, missing
        self.experiment = str(identity["dataset"]), str(identity["protocol"])
        # Values of each experiment by its label, the main one first, with the methods in the requested order.
        self.tables = {label: self._ordered(values_of(records, label)) for label in labels_of(records)}
        self.label: str | None = next(iter(self.tables), None)
        self.main: Values = next(iter(self.tables.values()), {})
        known = {metric for metrics in self.main.values() for metric in metrics}
        self.shown = [metric for metric, entry in METRICS.items() if metric in known and entry.heading]

    def _ordered(self, table: Values) -> Values:
        order = [*self.identity["methods"], CHOSEN_ON_TEST]
        return {method: table[method] for method in order if method in table}

    def opening(self) -> Section:
        dataset, name = self.experiment
        about = f"{PROTOCOLS[name].title} " if name in PROTOCOLS else ""
        cases = [case for record in self.records for case in record.cases if case.label == self.label]
        several, settings = f" ({self.label})" if len(self.tables) > 1 else "", ("metrics", "modes")
        trained = sorted(len(case.train) for case in cases) or [0]
        return Section(
            f"{name} on {dataset}",
            (
                *self._incomplete(),
                f"{about}Objects: {len(self.records)}; training recordings of each: "
                f"{' to '.join(map(str, dict.fromkeys((trained[0], trained[-1]))))}; test recordings in total: "
                f"{sum(len(case.test) for case in cases)}{several}; avmsf {self.identity['version']}, seed "
                f"{self.identity['seed']}.",
                "Values are means over an object's test recordings (CDPAM: over `cdpam_contacts` of them, 0 for all), "
                "then over objects, ± the standard error over objects. RMED is the distance between the located and "
                "the true contact relative to the diagonal of the object, by cosine distance; methods that cannot "
                "locate count as a random point. UMAP is the distance of edited modes from the center of the "
                "objects of the new material. Lower is better, except for MAC and CLAP. L1, "
                "L1-log and ENV follow the convention `paper` of docs/conventions.md; relative STFT does not depend on "
                "unit and level. An object's sounds are multiplied by one factor that "
                "brings its loudest recording to a peak of one.",
                WARNING,
                "Settings of metrics: {}. Of modes: {}.".format(*(_listed(self.identity[each]) for each in settings)),
            ),
        )

    def _incomplete(self) -> list[str]:
        """Return the sentence on missing results: methods are named only of objects that are begun."""
        begun = {record.identifier for record in self.records}
        listed = [f"{name} ({', '.join(each)})" if name in begun else name for name, each in self.missing.items()]
        objects, advice = counted(len(listed), "object"), "Run the same command again to compute them."
        return [f"Incomplete: results of {objects} are missing: {', '.join(listed)}. {advice}"] if listed else []

    def main_table(self) -> Section:
        (dataset, _), objects = self.experiment, _objects(*self.main.values())
        rows = [
            (*_row(method, metrics, self.shown), str(max(map(len, metrics.values()))))
            for method, metrics in self.main.items()
        ]
        paper = [row for row in PUBLISHED.get(self.experiment, ()) if row.label in (None, self.label)]
        rows += [(*_row(f"paper: {row.title}", row.values, self.shown), _DASH) for row in paper]
        best = set()
        for column, metric in enumerate(self.shown, 1):
            # Among the methods that have the metric of all objects that have it.
            total = len({name for metrics in self.main.values() for name in metrics.get(metric, ())})
            complete = {
                row: fmean(metrics[metric].values())
                for row, (method, metrics) in enumerate(self.main.items())
                if len(metrics.get(metric, ())) == total and method != CHOSEN_ON_TEST
            }
            if complete:
                best.add(((max if _is_rising(metric) else min)(complete, key=complete.__getitem__), column))
        remarks = [f"The paper has no values of this experiment on {dataset}."]
        if self.experiment in PUBLISHED:
            remarks = [f"Rows that begin with “paper:” are the paper's values on {dataset}."]
        if fewer := [method for method, metrics in self.main.items() if _objects(metrics) != objects]:
            remarks.insert(
                0,
                f"Not of all {len(objects)} objects: {', '.join(fewer)}. Their means are of other objects than those "
                "of the other rows, and not marked as best; ratios are of the same objects.",
            )
        if titles := [f"{each}: {METHODS[kind_of(each)].title}" for each in self.main if kind_of(each) in METHODS]:
            remarks.append(f"{'; '.join(titles)}.")
        title = "All methods" + (f": {self.label}" if len(self.tables) > 1 else "")
        columns = ("method", *(METRICS[metric].heading for metric in self.shown), "objects")
        return Section(title, (), columns, tuple(rows), frozenset(best), tuple(remarks))

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

    def median_table(self) -> Section:
        table = self._ordered(values_of(self.records, str(self.label), median))
        rows = [_row(method, metrics, self.shown) for method, metrics in table.items()]
        text = "Medians over an object's test recordings, which single contacts do not decide, then means over objects."
        return Section("Medians", (text,), ("method", *(METRICS[metric].heading for metric in self.shown)), tuple(rows))

    def case_table(self, metric: str) -> Section:
        methods = dict.fromkeys(method for table in self.tables.values() for method in table)
        rows = [
            _row(
                method, {label: table.get(method, {}).get(metric) for label, table in self.tables.items()}, self.tables
            )
            for method in methods
        ]
        paper = PUBLISHED.get(self.experiment, ())
        for title in dict.fromkeys(row.title for row in paper):
            own = {row.label: row.values[metric] for row in paper if row.title == title and metric in row.values}
            if own.keys() & self.tables.keys():
                rows.append(_row(f"paper: {title}", own, self.tables))
        return Section(f"{METRICS[metric].heading} by case", (), ("method", *self.tables), tuple(rows))

    def times(self) -> Section:
        times, rows, steps = list(times_of(self.records).values()), [], ("fit", "render")
        for method in self.identity["methods"]:
            found = [each["methods"][method] for each in times if method in each["methods"]]
            if found:
                rows.append((method, *(format_number(fmean(each[step] for each in found)) for step in steps)))
        if times:
            rows.append(("shared: modes and features", format_number(fmean(each["shared"] for each in times)), _DASH))
        text = "Seconds on one thread, mean over objects, sum over a protocol's cases, without computing metrics."
        if self.experiment in PUBLISHED:
            rows += [(f"paper: {title}", *map(format_number, seconds)) for title, seconds in COMPUTATION.items()]
            text += " Rows that begin with “paper:” are the paper's: one training and one sound on an A5000 GPU."
        return Section("Time per object", (text,), ("method", "fit", "render the test contacts"), tuple(rows))

    def failures(self) -> Section:
        rows = tuple(tuple(value or "all" for value in each.values()) for each in failures_of(self.records))
        columns = ("object", "case", "method", "reason") if rows else ()
        return Section("Failures", () if rows else ("None.",), columns, rows)


def _row(name: str, cells: Mapping[Any, Mapping[str, float] | float | None], columns: Iterable[str]) -> tuple[str, ...]:
    """Return a row of a table: of objects' values their mean with its standard error, and a dash for no value."""
    texts = []
    for cell in (cells.get(column) for column in columns):
        values = [*cell.values()] if isinstance(cell, Mapping) else []
        error, text = standard_error(values), format_number(fmean(values) if isinstance(cell, Mapping) else cell)
        texts.append(text if error is None else f"{text} ± {format_number(error, 2)}")
    return name, *texts


def _listed(settings: Mapping[str, Any]) -> str:
    """Return plain values as text, those of nested settings in parentheses."""
    return ", ".join(
        f"{name} ({_listed(value)})" if isinstance(value, Mapping) else f"{name} {value}"
        for name, value in settings.items()
    )
