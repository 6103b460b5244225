"""What a method is given to learn from: one object, some of its blows, and nothing of the others but their places."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from avmsf.bench.renderer import Renderer
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.fem.family import BodyFamily
from avmsf.field.gains.bodies import CandidateBodies
from avmsf.modal.extraction.extract import Extraction
from avmsf.scene.features import FeatureField
from avmsf.scene.gaussians import GaussianCloud

Look = Literal["positions", "visual", "unaligned", "paper", "paper-positions", "paper-unaligned"]
"""What a field reads of an object's points: positions alone; positions with what the places look like, made to obey the
object's symmetries; the same without that; features of Gaussians as the paper has them, their positions alone, and the
features without symmetry pooling."""


def _no_family() -> BodyFamily:
    raise EvaluationError("expected a mesh or views of the object, found none", name="mesh")


def _no_gaussians() -> GaussianCloud:
    raise EvaluationError("expected views, a mesh or a .ply of Gaussians of the object, found none", name="gaussians")


@dataclass(frozen=True, eq=False)
class Task:
    """One object and one choice of training contacts.

    What takes time is behind a function, which remembers what it made: methods that do not ask for it do not pay.
    """

    name: str
    """What the object is called, in messages and as a folder of others' sounds."""
    train: Impacts
    """The blows to learn from."""
    contacts: Float[Tensor, "contacts 3"]
    """Contacts of all the object's blows, training and test alike, meters."""
    names: tuple[str, ...]
    """Names of their recordings, row for row."""
    seed: int
    """Start of all chance in the method."""
    modes: Callable[[], Extraction]
    """Finds the modes of `train`, row for row."""
    features: Callable[[Look], FeatureField]
    """Makes what a field reads of the object's points. Raises SceneError where nothing shows the object's look."""
    bodies: Callable[[], CandidateBodies]
    """Computes what may lie behind the object's surface. Raises AvmsfError where its shape is unknown or unfit."""
    stranger: Callable[[], Float[Tensor, " samples"]]
    """Draws, by `seed`, the recording of another object, at the sample rate and of the length of `train`. Raises
    EvaluationError where there is no other object."""
    family: Callable[[], BodyFamily] = _no_family
    """Computes the bodies that the object's surface may enclose, of any material. Raises AvmsfError likewise."""
    material: str | None = None
    """What the dataset says that the object is made of, in lower case; None where it does not."""
    gaussians: Callable[[], GaussianCloud] = _no_gaussians
    """Fits Gaussians to the object's views. Raises AvmsfError where nothing shows its look."""


@runtime_checkable
class Method(Protocol):
    """A way to learn an object's sounds from some of them."""

    @property
    def name(self) -> str:
        """What tables and the command line call it; words joined by hyphens."""
        ...

    def fit(self, task: Task) -> Renderer:
        """Learn from the task's training blows. Raises AvmsfError where it cannot."""
        ...
