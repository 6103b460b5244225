"""The names and titles of methods and protocols; importing this loads nothing that computes."""

import difflib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from avmsf.errors import EvaluationError

PROTOCOL_NAMES = (
    "farthest",
    "leave-one-out",
    "closest",
    "predefined",
    "shots",
    "views",
    "ablation",
    "non-symmetric",
    "localize",
    "grid",
)
METHOD_TITLES: Mapping[str, str] = MappingProxyType(
    {
        "white-noise": "Gaussian noise at the level of the training recordings",
        "random-impact": "a recording of another object",
        "nearest": "the nearest training recording",
        "knn3": "mean waveform of the three nearest recordings (the paper's KNN)",
        "knn3-directions": "mean waveform of the three nearest recordings, by position and impact direction",
        "knn-gains": "modal gains averaged over the three nearest recordings",
        "spline-gains": "modal gains by thin-plate splines",
        "diffsound": "reimplementation of DiffSound, as in the paper",
        "diffsound-weighted": "DiffSound with a fitted weight for each mode",
        "field": "attention network, quick settings, visual features",
        "field-auto": "Gaussian process over kernel families (the default of this package)",
        "field-elastic": "Gaussian process on elastic mode shapes only",
        "field-smooth": "Gaussian process on distances only",
        "field-thin-plate": "Gaussian process of thin-plate splines only",
        "field-positions": "attention network, quick settings, positions only",
        "field-unaligned": "attention network, quick settings, without symmetry pooling",
        "field-no-initialization": "attention network, quick settings, without extracted modes",
        "field-no-residual": "attention network, quick settings, without residual noise",
        "field-warmup": "attention network, quick settings, warm-up only",
        "paper": "the paper's method with the preset `paper`, shared damping",
        "paper-positions": "the paper's method without visual features",
        "paper-no-initialization": "the paper's method without extracted modes",
        "paper-unaligned": "the paper's method without symmetry pooling",
        "paper-no-residual": "the paper's method without residual noise",
        "paper-per-contact": "the paper's method with damping per contact",
        "field-grid": "attention network, settings chosen from a small grid",
        "paper-grid": "the paper's method with settings chosen from its lists",
    }
)
"""Titles of all methods but those that take a path, by their names, in the order of tables."""
PUBLISHED, SMALL, RECORDED = "sonicgauss:", "sonicgauss-small:", "recorded:"
"""How the names of methods that take a path begin."""
_PATH_TITLES = {
    "sonicgauss": "SonicGauss with its published weights, trained on ObjectFolder Real, fine-tuned",
    "recorded": "sounds of another system, from files",
    "sonicgauss-small": "SonicGauss's objective at a small size, trained from scratch on simulated objects",
}


def expect_protocol(name: str) -> None:
    """Raise `EvaluationError`, which lists the known ones, for the name of no protocol."""
    if name not in PROTOCOL_NAMES:
        raise _unknown("protocol", name, PROTOCOL_NAMES)


def expect_method(name: str) -> None:
    """Raise `EvaluationError`, which lists the known ones, for the name of no method."""
    if name not in METHOD_TITLES and kind_of(name) not in _PATH_TITLES:
        raise _unknown("method", name, METHOD_TITLES, f", {PUBLISHED}FOLDER, {SMALL}FILE and {RECORDED}FOLDER")


def _unknown(kind: str, name: str, known: Iterable[str], others: str = "") -> EvaluationError:
    near = difflib.get_close_matches(name, known, n=1)
    advice = f"; did you mean {near[0]}?" if near else ""
    return EvaluationError(
        f"expected a {kind} of {', '.join(known)}{others}, got {name!r}{advice}", name=kind, value=name
    )


def expect_suited(method: str, protocol: str) -> None:
    """Raise `EvaluationError` for a method whose sounds cannot be those of the protocol's training recordings."""
    if method.startswith(RECORDED) and protocol == "shots":
        raise EvaluationError(
            f"{method}: expected a protocol that tests each recording once, got {protocol}, which trains on several "
            "sets of recordings, and the folder holds the sounds of one; choose farthest, closest, predefined or "
            "leave-one-out",
            name="method",
            value=method,
        )


def kind_of(method: str) -> str:
    """Return a method's name without the file or folder that it reads."""
    return method.partition(":")[0]


def title_of(method: str) -> str | None:
    """Return what reports call a method of this name, with or without its path; None for an unknown one."""
    kind = kind_of(method)
    return METHOD_TITLES.get(kind, _PATH_TITLES.get(kind))
