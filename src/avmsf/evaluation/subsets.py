"""Groups of objects within a dataset: those of the paper's smaller studies, and simulated ones with ground truth."""

from collections.abc import Mapping, Sequence

from avmsf.datasets import CaptureCollection
from avmsf.datasets.dataset import Dataset
from avmsf.datasets.numbering import ABLATION, NON_SYMMETRIC
from avmsf.errors import EvaluationError
from avmsf.evaluation.ground_truth import simulated
from avmsf.evaluation.protocols import EvaluationProtocol
from avmsf.simulate import sim20

ABLATED, NOT_SYMMETRIC = "ablation", "non-symmetric"
"""The groups' names."""
SUBSETS: Mapping[str, str] = {
    ABLATED: "those of the paper's ablations or the simulated ones in their place",
    NOT_SYMMETRIC: "those without rotational symmetry",
}
"""What the objects of each group have in common."""
_NUMBERS: Mapping[str, Sequence[str]] = {ABLATED: ABLATION, NOT_SYMMETRIC: NON_SYMMETRIC}

_SIMULATED: Mapping[str, Sequence[str]] = {ABLATED: sim20.ABLATED, NOT_SYMMETRIC: sim20.NON_SYMMETRIC}


def members(dataset: Dataset) -> dict[str, frozenset[str]]:
    """Return the groups that a dataset has objects of, by name.

    The numbers of ObjectFolder Real are RealImpact's too, before the first underscore of an object's name. Of captures
    only those are known that were simulated.
    """
    if isinstance(dataset, CaptureCollection):
        found = {name: simulated(dataset, names) for name, names in _SIMULATED.items()}
    else:
        objects = dataset.objects()
        found = {
            name: frozenset(each for each in objects if each.partition("_")[0] in numbers)
            for name, numbers in _NUMBERS.items()
        }
    return {name: each for name, each in found.items() if each}


def choose_objects(dataset: Dataset, protocol: EvaluationProtocol, asked: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the objects that take part: those asked for, else the protocol's group, else all.

    Raises DatasetError for unknown ones, and EvaluationError where the protocol is about a group that the dataset does
    not have.
    """
    if asked:
        return tuple(dict.fromkeys(dataset.facts(identifier).identifier for identifier in asked))
    if protocol.subset is not None:
        group = members(dataset).get(protocol.subset, frozenset())
        if group:
            return tuple(each for each in dataset.objects() if each in group)
        if protocol.required:
            raise EvaluationError.expected(
                f"objects of the group {protocol.subset}",
                protocol.subset,
                got="none",
                name="subset",
                advice="name objects with --objects",
            )
    return dataset.objects()
