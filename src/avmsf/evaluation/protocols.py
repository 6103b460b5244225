"""The experiments of the paper, as data: training and test contacts, metrics, and methods."""

from dataclasses import dataclass

from avmsf.evaluation.cases import Choosing, Closest, Farthest, FewerViews, Growing, LeaveOneOut, Predefined, Shots
from avmsf.evaluation.names import expect_protocol

BASELINE = "knn3"
"""The method that all others are compared with."""
PAPER_METRICS = ("l1", "l1_log", "envelope", "cdpam")
"""The columns of the paper's tables."""
OWN_METRICS = ("relative_stft", "mac", "gain_error")
"""Additional metrics: the last two where the ground truth is known."""
_TABLE = (
    "white-noise",
    "random-impact",
    "nearest",
    BASELINE,
    "knn3-directions",
    "knn-gains",
    "spline-gains",
    "field",
    "field-elastic",
    "field-auto",
)
LEARNING_CURVE, PREDEFINED = "learning-curve", "predefined"
_CURVES = (
    BASELINE,
    "knn3-directions",
    "knn-gains",
    "spline-gains",
    "field-positions",
    "field-smooth",
    "field-elastic",
    "field-auto",
)
"""Default methods: those that need no photographs of the object. All but the network, `field-positions`, take seconds
for each value."""
_ABLATED = ("field-positions", "field-no-initialization", "field-unaligned", "field-no-residual")


@dataclass(frozen=True)
class EvaluationProtocol:
    """One experiment."""

    name: str
    """What the command line calls it."""
    summary: str
    """What it does, in a sentence."""
    choosing: Choosing
    """How each object's contacts are split."""
    methods: tuple[str, ...] = _TABLE
    """Names of the methods that take part unless others are asked for; the baseline is among them."""
    subset: str | None = None
    """Name of the objects that take part unless others are asked for; None for all."""
    required: bool = False
    """Whether the subset is required; otherwise all objects of a dataset without such a subset take part."""
    metrics: tuple[str, ...] = (*PAPER_METRICS, *OWN_METRICS)
    """Columns of the tables, by the metrics' names."""
    locating: bool = False
    """Whether methods are evaluated by localizing the test recordings, not by their sounds."""


PROTOCOLS = {
    each.name: each
    for each in (
        EvaluationProtocol(
            "farthest",
            "Train on 20 % of the contacts, chosen by farthest-point sampling; test on the others.",
            Farthest(),
        ),
        EvaluationProtocol("leave-one-out", "Test on every contact once, after training on all others.", LeaveOneOut()),
        EvaluationProtocol(
            "closest", "Train on 20 % of the contacts, in one region; test on the others.", Closest(), subset="ablation"
        ),
        EvaluationProtocol(
            PREDEFINED, "Test on the recordings that are named; train on those at other contacts.", Predefined()
        ),
        EvaluationProtocol(
            "shots",
            "Train on nested subsets of 16, 8, 4, 2 and 1 contacts; test on the same others.",
            Shots(),
            subset="ablation",
        ),
        EvaluationProtocol(
            LEARNING_CURVE,
            "Train on growing subsets of contacts, chosen by farthest-point sampling; test on those left by the last.",
            Growing(),
            _CURVES,
            metrics=("l1", "l1_log", "envelope", *OWN_METRICS),
        ),
        EvaluationProtocol(
            "views",
            "Visual features from all views and from 12; train and test as in `farthest`.",
            FewerViews(),
            (BASELINE, "field"),
            subset="ablation",
        ),
        EvaluationProtocol(
            "ablation",
            "Ablations of one part each: visual features, initialization, symmetry pooling, residual noise.",
            Farthest(),
            (BASELINE, "field", *_ABLATED),
            subset="ablation",
        ),
        EvaluationProtocol(
            "non-symmetric",
            "As `farthest`, on objects without rotational symmetry.",
            Farthest(),
            subset="non-symmetric",
            required=True,
        ),
        EvaluationProtocol(
            "localize",
            "Train as in `farthest`; locate the test recordings, on objects without rotational symmetry.",
            Farthest(),
            ("white-noise", "nearest", "diffsound", "field", "field-no-residual", "field-auto"),
            subset="non-symmetric",
            required=True,
            metrics=("rmed", "rmed_posterior"),
            locating=True,
        ),
        EvaluationProtocol(
            "grid",
            "Choose the field's settings from a small grid on validation contacts (the paper's: `paper-grid`); "
            "test as in `farthest`.",
            Farthest(),
            (BASELINE, "field", "field-grid"),
            subset="ablation",
        ),
    )
}
"""All experiments by name."""


def protocol_named(name: str) -> EvaluationProtocol:
    """Return the protocol of this name. Raises EvaluationError that lists the known ones."""
    expect_protocol(name)
    return PROTOCOLS[name]
