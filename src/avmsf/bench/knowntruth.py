"""The truth of simulated objects, for those metrics that need one."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from avmsf.capture.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.simulate.truth import TRUTH, Truth, read_truth


def truth_of(dataset: Dataset, identifier: str) -> Truth | None:
    """Return what is known of an object's modes; None for recorded objects. Raises as `read_truth`."""
    path = _path(dataset, identifier)
    return None if path is None else read_truth(path)


def simulated(dataset: Dataset, names: Sequence[str]) -> frozenset[str]:
    """Return which of the named objects the dataset has and were simulated."""
    return frozenset(each for each in dataset.objects() if each in names and _path(dataset, each) is not None)


def truth_at(truth: Truth, names: tuple[str, ...]) -> Truth:
    """Return the truth of the named recordings, row for row. Raises EvaluationError where it does not know one."""
    rows = {name: row for row, name in enumerate(truth.names)}
    unknown = [name for name in names if name not in rows]
    if unknown:
        raise EvaluationError(
            f"the truth knows {len(rows)} recordings and {unknown[0]} is not among them; simulate the object again"
        )
    taken = [rows[name] for name in names]
    contacts = None if truth.contacts is None else truth.contacts[taken]
    return replace(truth, gains=truth.gains[taken], quadrature=truth.quadrature[taken], names=names, contacts=contacts)


def _path(dataset: Dataset, identifier: str) -> Path | None:
    look = dataset.look(identifier)
    return look.folder / TRUTH if look is not None and (look.folder / TRUTH).is_file() else None
