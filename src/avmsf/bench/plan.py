"""All that decides an evaluation's figures, in one value that travels to other processes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Protocol, runtime_checkable

from avmsf._utils.caching import source_digest
from avmsf.bench.judging import Judging
from avmsf.bench.protocols import EvaluationProtocol
from avmsf.bench.results import ResultsFolder
from avmsf.bench.task import Look, Method
from avmsf.capture.datasets.dataset import Dataset
from avmsf.fem.family import BodyFamily
from avmsf.field.gains.bodies import CandidateBodies
from avmsf.modal.extraction.finders import HighResolution, ModeFinder
from avmsf.scene.features import FeatureField
from avmsf.scene.gaussians import GaussianCloud


@runtime_checkable
class FeatureMaker(Protocol):
    """Makes what fields read of an object's points."""

    def __call__(self, identifier: str, look: Look, views: int | None = None) -> FeatureField:
        """Return an object's features, from at most `views` views. Raises SceneError where nothing shows its look."""
        ...


@runtime_checkable
class BodyMaker(Protocol):
    """Makes what fields and simulations know of an object's shape."""

    def __call__(self, identifier: str) -> CandidateBodies:
        """Return an object's bodies. Raises AvmsfError where its shape is unknown or unfit."""
        ...

    def family(self, identifier: str) -> BodyFamily:
        """Return its bodies of any material and thickness, for simulations. Raises AvmsfError likewise."""
        ...


@runtime_checkable
class CloudMaker(Protocol):
    """Makes an object's Gaussians."""

    def __call__(self, identifier: str, views: int | None = None) -> GaussianCloud:
        """Return an object's Gaussians, from at most `views` views. Raises SceneError where nothing shows its look."""
        ...


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What is evaluated, on what, and how."""

    dataset: Dataset
    title: str
    """What reports call the dataset; results of another are not mixed with its own."""
    protocol: EvaluationProtocol
    methods: tuple[Method, ...]
    features: FeatureMaker
    bodies: BodyMaker
    seed: int = 0
    """Start of all chance in the methods."""
    judging: Judging = field(default_factory=Judging)
    finder: ModeFinder = field(default_factory=HighResolution)
    """How modes are found, once a case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Plain values that decide the features."""
    clouds: CloudMaker | None = None
    """None where no method reads Gaussians."""

    def begin(self, results: ResultsFolder) -> None:
        """Take a folder for this evaluation's results.

        Raises EvaluationError where the folder holds other ones, and where a metric's package is not installed.
        """
        if not self.protocol.locating:
            self.judging.prepare()
        identity = {
            "version": version("avmsf"),
            "source": source_digest(),
            "protocol": self.protocol.name,
            "choosing": repr(self.protocol.choosing),
            "dataset": self.title,
            "seed": self.seed,
            "metrics": repr(self.judging),
            "modes": repr(self.finder),
            "settings": dict(self.settings),
        }
        results.begin(identity, {method.name: repr(method) for method in self.methods})
