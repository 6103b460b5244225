"""The training data of a method: one object, its training recordings, and the contacts of all recordings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.renderer import Renderer
from avmsf.features.feature_field import FeatureField
from avmsf.fem.body_family import BodyFamily
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.extraction.extract import Extraction

Look = Literal["surface", "positions", "visual", "unaligned", "paper", "paper-positions", "paper-unaligned"]
"""Features of an object's points. `surface`: positions of points on its mesh, or as `positions` without one.
`positions`: only the positions of the points that visual features are of. `visual`: positions with visual features,
pooled over the object's symmetries; `unaligned`: without pooling. `paper`: the paper's features of Gaussians;
`paper-positions`: only their positions; `paper-unaligned`: without pooling."""


_OMIT = "give one, or omit the methods that need it"


def _no_family() -> BodyFamily:
    raise EvaluationError.expected("a mesh or views of the object", name="mesh", advice=_OMIT)


def _no_gaussians() -> GaussianCloud:
    raise EvaluationError.expected("views, a mesh or a .ply of the object", name="gaussians", advice=_OMIT)


@dataclass(frozen=True, eq=False)
class Task:
    """One object and one choice of training contacts.

    Slow inputs are cached functions, so that methods that do not use them take no time for them.
    """

    name: str
    """Name of the object, in messages and as the folder of other systems' sounds."""
    train: Impacts
    """The training recordings."""
    contacts: Float[Tensor, "contacts 3"]
    """Contacts of all recordings of the object, training and test, meters."""
    names: tuple[str, ...]
    """Names of their recordings, row for row."""
    seed: int
    """Random seed of the method."""
    modes: Callable[[], Extraction]
    """Extracts the modes of `train`, row for row."""
    features: Callable[[Look], FeatureField]
    """Computes the features of the object's points. Raises SceneError without visual input."""
    bodies: Callable[[], CandidateBodies]
    """Computes the candidate FE models of the object. Raises AvmsfError where its shape is unknown or unfit."""
    stranger: Callable[[], Float[Tensor, " samples"]]
    """Draws, by `seed`, the recording of another object, at the sample rate and of the length of `train`. Raises
    EvaluationError where there is no other object."""
    family: Callable[[], BodyFamily] = _no_family
    """Computes the FE models of the object's surface, of any material. Raises AvmsfError likewise."""
    material: str | None = None
    """Material of the object in the dataset, in lower case; None where it is unknown."""
    gaussians: Callable[[], GaussianCloud] = _no_gaussians
    """Fits Gaussians to the object's views. Raises AvmsfError without views."""
    device: str | None = None
    """Device to train on; None for a GPU where there is one."""


@runtime_checkable
class Method(Protocol):
    """A method that predicts an object's sounds from its training recordings."""

    @property
    def name(self) -> str:
        """Name in tables and on the command line; words joined by hyphens."""
        ...

    def fit(self, task: Task) -> Renderer:
        """Fit a renderer to the task's training recordings. Raises AvmsfError where it cannot."""
        ...


@runtime_checkable
class Looking(Protocol):
    """A method that reads features of the object's points."""

    @property
    def look(self) -> Look:
        """Which ones it reads."""
        ...


@runtime_checkable
class FromFiles(Protocol):
    """A method whose sounds were made elsewhere and may change from one run to the next."""

    def digest(self, name: str) -> str:
        """Return what tells an object's files apart from others: its results count only for these."""
        ...
