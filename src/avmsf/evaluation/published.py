"""The values of the paper's tables.

The paper's metrics are described in words only, so that the convention ours are taken in is an inference
(`avmsf.evaluation.metrics`): ratios between methods may be compared, absolute values may not.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from avmsf.evaluation.registry import BASELINE

PAPER_METRICS = ("l1", "l1_log", "envelope", "cdpam")
"""The columns of the paper's tables."""


@dataclass(frozen=True)
class PublishedRow:
    """One row of one of the paper's tables."""

    title: str
    """What the paper calls the method."""
    values: Mapping[str, float]
    """By metric; lower is better in all."""
    method: str | None = None
    """What the method is called here; None for those that are not here."""
    label: str | None = None
    """Label of the case that the row belongs to; None for the protocol's only one."""


def _row(title: str, method: str | None, *values: float, label: str | None = None) -> PublishedRow:
    return PublishedRow(title, dict(zip(PAPER_METRICS, values, strict=False)), method, label)


OBJECTFOLDER, REALIMPACT = "ObjectFolder Real", "RealImpact"
PUBLISHED: Mapping[tuple[str, str], tuple[PublishedRow, ...]] = {
    (OBJECTFOLDER, "farthest"): (
        _row("White Noise", "white-noise", 3.774, 6.859, 0.305, 1.35e-3),
        _row("Random Impact", "random-impact", 0.035, 1.367, 0.019, 2.47e-4),
        _row("KNN", "knn3", 0.014, 0.930, 0.014, 1.53e-4),
        _row("DiffSound", "paper-diffsound", 0.031, 1.298, 0.030, 2.53e-4),
        _row("SonicGauss", "sonicgauss", 0.033, 1.281, 0.018, 2.01e-4),
        _row("AV-MSF", "av-msf", 0.013, 0.951, 0.014, 1.35e-4),
    ),
    (REALIMPACT, "leave-one-out"): (
        _row("White Noise", "white-noise", 3.789, 7.258, 0.308, 1.23e-3),
        _row("Random Impact", "random-impact", 0.039, 1.582, 0.022, 2.71e-4),
        _row("KNN", "knn3", 0.026, 1.036, 0.017, 2.25e-4),
        _row("DiffSound", "paper-diffsound", 0.029, 1.533, 0.024, 2.39e-4),
        _row("SonicGauss", "sonicgauss", 0.039, 1.580, 0.025, 2.43e-4),
        _row("AV-MSF", "av-msf", 0.021, 0.996, 0.017, 2.16e-4),
    ),
    # Its objects and prompts are not published, and every set of objects has another UMAP.
    (REALIMPACT, "edit"): tuple(
        PublishedRow(title, {"umap": value}, method)
        for title, method, value in (
            ("Generation", "generation", 3.077),
            ("Audio-SDS", "edit-independent", 4.234),
            ("AV-MSF", "edit-published", 2.753),
        )
    ),
    (OBJECTFOLDER, "ablation"): (
        _row("AV-MSF", "av-msf", 0.019, 0.927, 0.015, 2.00e-4),
        _row("without visual", "paper-positions", 0.028, 1.148, 0.015, 4.20e-4),
        _row("without initialization", "paper-no-initialization", 0.045, 1.077, 0.026, 2.97e-4),
        _row("without alignment", "paper-unaligned", 0.019, 1.002, 0.016, 2.62e-4),
        _row("without residual", "paper-no-residual", 0.031, 5.764, 0.026, 3.22e-4),
    ),
    (OBJECTFOLDER, "non-symmetric"): (
        _row("KNN", "knn3", 0.0135, 0.9724, 0.0138, 2.15e-4),
        _row("AV-MSF", "av-msf", 0.0110, 0.9259, 0.0131, 1.53e-4),
    ),
    (OBJECTFOLDER, "closest"): (_row("AV-MSF", "av-msf", 0.019, 1.010, 0.015, 2.08e-4),),
    (OBJECTFOLDER, "views"): (
        _row("AV-MSF", "av-msf", 0.019, 0.927, 0.015, 2.00e-4, label="all views"),
        _row("AV-MSF", "av-msf", 0.020, 1.002, 0.016, 2.84e-4, label="12 views"),
    ),
    (OBJECTFOLDER, "localize"): (
        PublishedRow("DiffSound", {"rmed": 0.4178}, "paper-diffsound"),
        PublishedRow("AV-MSF", {"rmed": 0.3461}, "av-msf"),
        PublishedRow("AV-MSF, ablation subset", {"rmed": 0.384}, "av-msf"),
        PublishedRow("without residual, ablation subset", {"rmed": 0.438}, "paper-no-residual"),
    ),
    (OBJECTFOLDER, "shots"): tuple(
        _row(title, method, figure, label=label)
        for title, method, figures in (
            ("DiffSound", "paper-diffsound", (0.0254, 0.0253, 0.0253, 0.0255, 0.0254)),
            ("SonicGauss", "sonicgauss", (0.0245, 0.0259, 0.0336, 0.0855, 0.0952)),
            ("AV-MSF", "av-msf", (0.0143, 0.0153, 0.0224, 0.0223, 0.0256)),
        )
        for label, figure in zip(("16 shots", "8 shots", "4 shots", "2 shots", "1 shot"), figures, strict=True)
    ),
}
"""All the paper's tables that the protocols compute (its tables 1 to 3, and the supplement's), by dataset and
protocol."""

COMPUTATION: Mapping[str, tuple[float, float]] = {
    "AV-MSF": (0.27 * 3600, 0.0438),
    "SonicGauss": (0.59 * 3600, 3.2),
    "DiffSound": (3.16 * 3600, 0.0069),
}
"""Seconds to train on one object and to render one sound on an A5000 GPU (supplement), by the paper's names."""


def published_ratios(protocol: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return the paper's ratios to its KNN, of the tables' means, by dataset, method and metric.

    Of the tables of this protocol that have both; the main tables stand for a protocol that has none.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for (dataset, name), rows in PUBLISHED.items():
        knn = next((row.values for row in rows if row.method == BASELINE), None)
        if name == protocol and knn is not None:
            found[dataset] = {
                row.method: {metric: row.values[metric] / knn[metric] for metric in PAPER_METRICS}
                for row in rows
                if row.method is not None
            }
            # What comes near to a row may be compared with it too.
            for own, row in {"paper": "av-msf", "diffsound": "paper-diffsound"}.items():
                if row in found[dataset]:
                    found[dataset][own] = found[dataset][row]
    return found or {**published_ratios("farthest"), **published_ratios("leave-one-out")}
