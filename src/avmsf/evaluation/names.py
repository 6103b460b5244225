"""The names of protocols and methods; importing this loads nothing that computes."""

import difflib
from collections.abc import Sequence

from avmsf.errors import EvaluationError

PROTOCOL_NAMES = (
    "farthest",
    "leave-one-out",
    "closest",
    "predefined",
    "shots",
    "learning-curve",
    "views",
    "ablation",
    "non-symmetric",
    "localize",
    "grid",
)
METHOD_NAMES = (
    "white-noise",
    "random-impact",
    "nearest",
    "knn3",
    "knn3-directions",
    "knn-gains",
    "spline-gains",
    "diffsound",
    "diffsound-weighted",
    "field",
    "field-auto",
    "field-elastic",
    "field-smooth",
    "field-thin-plate",
    "field-positions",
    "field-unaligned",
    "field-no-initialization",
    "field-no-residual",
    "field-warmup",
    "paper",
    "paper-positions",
    "paper-no-initialization",
    "paper-unaligned",
    "paper-no-residual",
    "paper-per-contact",
    "field-grid",
    "paper-grid",
)
"""All methods but those that take a path, in the order of tables."""
PUBLISHED, SMALL, RECORDED = "sonicgauss:", "sonicgauss-small:", "recorded:"
"""How the names of methods that take a path begin."""
_SEVERAL_SETS = ("shots", "learning-curve")
"""Protocols that test a recording after training on several sets of others."""


def expect_protocol(name: str) -> None:
    """Raise `EvaluationError`, which lists the known ones, for the name of no protocol."""
    if name not in PROTOCOL_NAMES:
        raise EvaluationError(
            f"expected a protocol of {', '.join(PROTOCOL_NAMES)}, got {name!r}{_guess(name, PROTOCOL_NAMES)}",
            name="protocol",
            value=name,
        )


def expect_method(name: str) -> None:
    """Raise `EvaluationError`, which lists the known ones, for the name of no method."""
    if name not in METHOD_NAMES and name.partition(":")[0] + ":" not in (PUBLISHED, SMALL, RECORDED):
        raise EvaluationError(
            f"expected a method of {', '.join(METHOD_NAMES)}, {PUBLISHED}FOLDER, {SMALL}FILE and {RECORDED}FOLDER, got "
            f"{name!r}{_guess(name, METHOD_NAMES)}",
            name="method",
            value=name,
        )


def expect_suited(method: str, protocol: str) -> None:
    """Raise `EvaluationError` for a method whose sounds cannot be those of the protocol's training recordings."""
    if method.startswith(RECORDED) and protocol in _SEVERAL_SETS:
        raise EvaluationError(
            f"{method}: expected a protocol that tests each recording once, got {protocol}, which trains on several "
            "sets of recordings, and the folder holds the sounds of one; choose farthest, closest, predefined or "
            "leave-one-out",
            name="method",
            value=method,
        )


def _guess(name: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {near[0]}?" if near else ""
