"""Statistics of stored values: means over contacts, then over objects; ratios to the baseline.

Every object has the same weight. A method's mean is over the objects that it has values of; ratios are over those that
the baseline has values above 0 of too, paired by object. The ratio is the geometric mean of the objects' ratios, so
that it does not depend on level and swapping the methods inverts it; the ratio of the means, the only one that the
paper's tables allow, is given too.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, geometric_mean, stdev
from typing import Any, TypeVar

from avmsf.evaluation.registry import BASELINE, METRICS
from avmsf.evaluation.results import ObjectRecord, Outcome

Value = TypeVar("Value")
Table = Mapping[str, Mapping[str, Value]]
"""By method and metric."""
Values = Mapping[str, Table[float]]
"""By object, method and metric."""


@dataclass(frozen=True)
class Mean:
    """A mean over objects."""

    mean: float
    standard_error: float | None
    """As if the objects were a random sample; None for a single one."""
    objects: int

    @classmethod
    def of(cls, values: Sequence[float]) -> "Mean":
        """Return the mean of at least one value."""
        error = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
        return cls(fmean(values), error, len(values))


def is_rising(metric: str) -> bool:
    """Whether more of a metric is better; all others are errors, and only they have ratios."""
    return metric in METRICS and METRICS[metric].rising


def labels_of(records: Iterable[ObjectRecord]) -> tuple[str, ...]:
    """Return the experiments' labels, in the protocol's order; the first is the main one."""
    found = (tuple(dict.fromkeys(case.label for case in record.cases)) for record in records)
    return max(found, key=len, default=())


def object_values(record: ObjectRecord, label: str) -> dict[str, dict[str, float]]:
    """Return an object's figures in one experiment by method and metric: means over its contacts.

    A method that failed in any of the experiment's parts has none.
    """
    keys = {case.key for case in record.cases if case.label == label}
    table = {}
    for method in dict.fromkeys(each.method for each in record.outcomes):
        outcomes = [each for each in record.outcomes if each.method == method and each.case in keys]
        if len(outcomes) < len(keys) or any(each.failure is not None for each in outcomes):
            continue
        found: dict[str, list[float]] = {}
        for each in outcomes:
            for metric, values in (*each.values.items(), *((name, (one,)) for name, one in each.figures.items())):
                found.setdefault(metric, []).extend(value for value in values if value is not None)
        table[method] = {metric: math.fsum(values) / len(values) for metric, values in found.items() if values}
    return table


def values_of(records: Iterable[ObjectRecord], label: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return all objects' figures in one experiment; objects without any are left out."""
    figures = {record.identifier: object_values(record, label) for record in records}
    return {identifier: found for identifier, found in figures.items() if found}


def means(table: Values) -> dict[str, dict[str, Mean]]:
    """Return the means over objects by method and metric."""
    found: dict[str, dict[str, list[float]]] = {}
    for figures in table.values():
        for method, values in figures.items():
            for metric, value in values.items():
                found.setdefault(method, {}).setdefault(metric, []).append(value)
    return {method: {metric: Mean.of(each) for metric, each in values.items()} for method, values in found.items()}


def ratios(table: Values, *, of_means: bool = False) -> dict[str, dict[str, float]]:
    """Return the geometric means of the ratios to the baseline, object by object, or the ratios `of_means`."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for figures in table.values():
        known = {metric: value for metric, value in figures.get(BASELINE, {}).items() if value > 0}
        for method, values in figures.items():
            for metric in (each for each in values if each in known):
                pairs = found.setdefault(method, {})
                if not is_rising(metric):
                    pairs.setdefault(metric, []).append((values[metric], known[metric]))
    return {
        method: {metric: _ratio(*zip(*each, strict=True), of_means=of_means) for metric, each in values.items()}
        for method, values in found.items()
    }


def _ratio(own: Sequence[float], other: Sequence[float], *, of_means: bool) -> float:
    if of_means:
        return math.fsum(own) / math.fsum(other)
    return geometric_mean([one / base for one, base in zip(own, other, strict=True)]) if min(own) > 0 else 0.0


def summarize(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    *,
    subsets: Mapping[str, frozenset[str]] | None = None,
    missing: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return all figures as plain values, of which the same records always give the same.

    `methods`, `standard_errors`, `ratio_to_knn3` and the like are of the main experiment, `cases` of each; `subsets`
    names groups of objects that have means of their own; `missing` are the results that are yet to be computed.
    """
    labels = labels_of(records)
    tables = {label: values_of(records, label) for label in labels}
    main = tables[labels[0]] if labels else {}
    found = means(main)
    parts = {name: {each: main[each] for each in main if each in members} for name, members in (subsets or {}).items()}
    return {
        **{key: identity.get(key) for key in ("protocol", "dataset", "version", "seed", "metrics")},
        "main_case": labels[0] if labels else None,
        "objects": len(records),
        "test_contacts": sum(
            len({name for case in each.cases if case.label in labels[:1] for name in case.test}) for each in records
        ),
        "methods": _plain(found),
        "standard_errors": _plain(found, "standard_error"),
        "counts": {method: max(each.objects for each in figures.values()) for method, figures in found.items()},
        f"ratio_to_{BASELINE}": ratios(main),
        f"ratio_of_means_to_{BASELINE}": ratios(main, of_means=True),
        "cases": {label: _plain(means(table)) for label, table in tables.items()},
        "subsets": {
            name: {"objects": len(table), "methods": _plain(means(table))} for name, table in parts.items() if table
        },
        "failures": failures_of(records),
        "missing": {name: list(methods) for name, methods in (missing or {}).items()},
    }


def _plain(table: Table[Mean], name: str = "mean") -> dict[str, dict[str, Any]]:
    return {method: {metric: getattr(each, name) for metric, each in row.items()} for method, row in table.items()}


def missing_of(records: Iterable[ObjectRecord], wanted: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return, of the wanted methods of each object, those without an outcome in all of its cases.

    A failure is an outcome. Objects that lack nothing are left out.
    """
    known, missing = {record.identifier: record for record in records}, {}
    for name, methods in wanted.items():
        record = known.get(name)
        if record is None:
            missing[name] = list(methods)
        elif record.failure is None:
            found = {(each.case, each.method) for each in record.outcomes}
            missing[name] = [each for each in methods if any((case.key, each) not in found for case in record.cases)]
    return {name: methods for name, methods in missing.items() if methods}


def failures_of(records: Iterable[ObjectRecord]) -> list[dict[str, str | None]]:
    """Return the failures with their reasons, each in one line."""
    found: list[dict[str, str | None]] = []

    def add(failed: ObjectRecord | Outcome, name: str, case: str | None, method: str | None) -> None:
        if failed.failure is not None:
            reason = failed.failure.partition("\n")[0]
            found.append({"object": name, "case": case, "method": method, "failure": reason})

    for record in records:
        add(record, record.identifier, None, None)
        order = {case.key: number for number, case in enumerate(record.cases)}
        for each in sorted(record.outcomes, key=lambda each: (order.get(each.case, len(order)), each.method)):
            add(each, record.identifier, each.case, each.method)
    return found


def times_of(records: Iterable[ObjectRecord]) -> dict[str, dict[str, Any]]:
    """Return each object's seconds: what methods share, and each method's to fit and to render all test contacts."""
    times = {}
    for record in records:
        methods: dict[str, list[Outcome]] = {}
        for each in record.outcomes:
            methods.setdefault(each.method, []).append(each)
        times[record.identifier] = {
            "shared": math.fsum(case.shared_seconds for case in record.cases),
            "methods": {
                method: {
                    "fit": math.fsum(each.fit_seconds for each in outcomes),
                    "render": math.fsum(each.render_seconds for each in outcomes),
                }
                for method, outcomes in methods.items()
            },
        }
    return times
