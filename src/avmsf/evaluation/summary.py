"""Statistics of stored values: means over contacts, then over objects; differences between methods.

Every object has the same weight. A method's mean is over the objects that it has values of; differences and ratios are
over those that the baseline has values of too, paired by object. The ratio is the geometric mean of the objects'
ratios, so that it does not depend on level and swapping the methods inverts it; the ratio of the means, the only one
that the paper's tables allow, is given too.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from avmsf.evaluation.protocols import BASELINE
from avmsf.evaluation.results import ObjectRecord, Outcome

RISING = frozenset({"mac", "found"})
"""Metrics of which more is better; all others are errors, and only they have ratios."""
Table = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Figures by object, method and metric."""


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
        count = len(values)
        mean = math.fsum(values) / count
        if count == 1:
            return cls(mean, None, 1)
        variance = math.fsum((value - mean) ** 2 for value in values) / (count - 1)
        return cls(mean, math.sqrt(variance / count), count)


def labels_of(records: Iterable[ObjectRecord]) -> tuple[str, ...]:
    """Return the experiments' labels, in the protocol's order; the first is the main one."""
    found = (tuple(dict.fromkeys(case.label for case in record.cases)) for record in records)
    return max(found, key=len, default=())


def object_figures(record: ObjectRecord, label: str) -> dict[str, dict[str, float]]:
    """Return an object's figures in one experiment by method and metric: means over its contacts.

    A method that failed in any of the experiment's parts has none.
    """
    keys = {case.key for case in record.cases if case.label == label}
    figures = {}
    for method in dict.fromkeys(each.method for each in record.outcomes):
        outcomes = [each for each in record.outcomes if each.method == method and each.case in keys]
        if len(outcomes) < len(keys) or any(each.failure is not None for each in outcomes):
            continue
        found: dict[str, list[float]] = {}
        for each in outcomes:
            for metric, values in each.values.items():
                found.setdefault(metric, []).extend(value for value in values if value is not None)
            for metric, figure in each.figures.items():
                found.setdefault(metric, []).extend([] if figure is None else [figure])
        figures[method] = {metric: math.fsum(values) / len(values) for metric, values in found.items() if values}
    return figures


def figures_of(records: Iterable[ObjectRecord], label: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return all objects' figures in one experiment; objects without any are left out."""
    figures = {record.identifier: object_figures(record, label) for record in records}
    return {identifier: found for identifier, found in figures.items() if found}


def means(table: Table) -> dict[str, dict[str, Mean]]:
    """Return the means over objects by method and metric."""
    return _over_objects(table, lambda own, other: own, paired=False)


def differences(table: Table) -> dict[str, dict[str, Mean]]:
    """Return the mean differences to the baseline, object by object."""
    return _over_objects(table, lambda own, other: own - other, paired=True)


def ratios(table: Table) -> dict[str, dict[str, float]]:
    """Return the geometric means of the ratios to the baseline, object by object."""

    def logarithm(own: float, other: float) -> float:
        return math.log(own / other) if own > 0 else -math.inf

    found = _over_objects(table, logarithm, paired=True, positive=True)
    return {
        method: {metric: math.exp(each.mean) for metric, each in figures.items() if metric not in RISING}
        for method, figures in found.items()
    }


def ratios_of_means(table: Table) -> dict[str, dict[str, float]]:
    """Return the methods' means over the baseline's, both over the objects that have both."""
    own = _over_objects(table, lambda own, other: own, paired=True, positive=True)
    other = _over_objects(table, lambda own, other: other, paired=True, positive=True)
    return {
        method: {
            metric: each.mean / other[method][metric].mean for metric, each in figures.items() if metric not in RISING
        }
        for method, figures in own.items()
    }


def summarize(
    records: Sequence[ObjectRecord],
    identity: Mapping[str, Any],
    *,
    subsets: Mapping[str, frozenset[str]] | None = None,
    missing: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Any]:
    """Return all figures as plain values, of which the same records always give the same.

    `methods`, `standard_errors`, `ratio_to_knn3` and the like are of the main experiment, `cases` of each; `subsets`
    names groups of objects whose means are told apart; `missing` are the results that are yet to be computed.
    """
    labels = labels_of(records)
    tables = {label: figures_of(records, label) for label in labels}
    main = tables[labels[0]] if labels else {}
    found = means(main)
    parts = {name: {each: main[each] for each in main if each in members} for name, members in (subsets or {}).items()}
    return {
        **{key: identity.get(key) for key in ("protocol", "dataset", "version", "seed", "metrics")},
        "main_case": labels[0] if labels else None,
        "objects": len(records),
        "test_contacts": sum(
            len(set().union(*(case.test for case in record.cases if case.label == labels[0]))) for record in records
        )
        if labels
        else 0,
        "methods": _plain(found, lambda each: each.mean),
        "standard_errors": _plain(found, lambda each: each.standard_error),
        "counts": {method: max(each.objects for each in figures.values()) for method, figures in found.items()},
        f"difference_to_{BASELINE}": _plain(
            differences(main), lambda each: {"mean": each.mean, "standard_error": each.standard_error}
        ),
        f"ratio_to_{BASELINE}": ratios(main),
        f"ratio_of_means_to_{BASELINE}": ratios_of_means(main),
        "cases": {label: _plain(means(table), lambda each: each.mean) for label, table in tables.items()},
        "subsets": {
            name: {"objects": len(table), "methods": _plain(means(table), lambda each: each.mean)}
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
    known = {record.identifier: record for record in records}
    missing = {}
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
    for record in records:
        if record.failure is not None:
            found.append({"object": record.identifier, "case": None, "method": None, "failure": _reason(record)})
        order = {case.key: number for number, case in enumerate(record.cases)}
        failed = [each for each in record.outcomes if each.failure is not None]
        found += [
            {"object": record.identifier, "case": each.case, "method": each.method, "failure": _reason(each)}
            for each in sorted(failed, key=lambda each: (order.get(each.case, len(order)), each.method))
        ]
    return found


def _reason(failed: ObjectRecord | Outcome) -> str:
    return (failed.failure or "").partition("\n")[0]


def times_of(records: Iterable[ObjectRecord]) -> dict[str, dict[str, Any]]:
    """Return each object's seconds: what methods share, and each method's to fit and to render all test contacts."""
    return {
        record.identifier: {
            "shared": math.fsum(case.shared_seconds for case in record.cases),
            "methods": {
                method: {
                    "fit": math.fsum(each.fit_seconds for each in record.outcomes if each.method == method),
                    "render": math.fsum(each.render_seconds for each in record.outcomes if each.method == method),
                }
                for method in dict.fromkeys(each.method for each in record.outcomes)
            },
        }
        for record in records
    }


def _over_objects(
    table: Table, combine: Callable[[float, float], float], *, paired: bool, positive: bool = False
) -> dict[str, dict[str, Mean]]:
    """Return means of what `combine` makes of a method's figure and the baseline's, over the objects that have both.

    Unless `paired`, an object needs no baseline; with `positive`, the baseline's figure must be more than 0.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for figures in table.values():
        for method, values in figures.items():
            for metric, own in values.items():
                other = figures.get(BASELINE, {}).get(metric)
                if paired and (other is None or (positive and not other > 0)):
                    continue
                value = combine(own, math.nan if other is None else other)
                found.setdefault(method, {}).setdefault(metric, []).append(value)
    return {
        method: {metric: Mean.of(values) for metric, values in figures.items()} for method, figures in found.items()
    }


def _plain(figures: Mapping[str, Mapping[str, Mean]], read: Callable[[Mean], Any]) -> dict[str, dict[str, Any]]:
    return {method: {metric: read(each) for metric, each in values.items()} for method, values in figures.items()}
