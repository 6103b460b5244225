"""The settings of an evaluation, in one value that can be sent to other processes."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.metadata import version
from typing import Any, Protocol, runtime_checkable

from avmsf._utils.caching import source_digest
from avmsf.datasets.dataset import Dataset
from avmsf.evaluation.protocols import EvaluationProtocol
from avmsf.evaluation.results import ENCODER, ResultsFolder
from avmsf.evaluation.sound_metrics import Judging
from avmsf.evaluation.task import Look, Looking, Method
from avmsf.features.feature_field import FeatureField
from avmsf.fem.body_family import BodyFamily
from avmsf.field.gains.elastic import CandidateBodies
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.extraction.finders import HighResolution, ModeFinder


@runtime_checkable
class FeatureMaker(Protocol):
    """Computes an object's features."""

    def __call__(self, identifier: str, look: Look, views: int | None = None) -> FeatureField:
        """Return an object's features, from at most `views` views. Raises SceneError without visual input."""
        ...


@runtime_checkable
class BodyMaker(Protocol):
    """Computes an object's FE models."""

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
        """Return an object's Gaussians, from at most `views` views. Raises SceneError without visual input."""
        ...


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Data set, protocol, methods and settings of an evaluation."""

    dataset: Dataset
    title: str
    """Name of the dataset in reports; one folder of results has one."""
    protocol: EvaluationProtocol
    methods: tuple[Method, ...]
    features: FeatureMaker
    bodies: BodyMaker
    seed: int = 0
    """Random seed of the methods."""
    judging: Judging = field(default_factory=Judging)
    finder: ModeFinder = field(default_factory=HighResolution)
    """Extraction of modes, once per case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the features, as plain values."""
    clouds: CloudMaker | None = None
    """None where no method reads Gaussians."""
    device: str | None = None
    """Device that methods train on, with the same result up to rounding; None for a GPU where there is one."""
    encoder: str | None = None
    """Encoder that `auto` in the settings stands for; None where the settings name it, or no method reads features."""
    time_zero: str | None = None
    """Start of the dataset's sounds, `onset` or `peak`, on which all methods are scored; None for the dataset's own."""
    own_starts: Dataset | None = None
    """The same dataset with its own starts, for fields that are not of the paper's configuration; None where all
    methods are fitted to the sounds that they are scored on."""

    options: Mapping[str, str] = field(default_factory=dict)
    """What a command line spelled of all this, by option, for messages."""

    def begin(self, results: ResultsFolder) -> None:
        """Take a folder for this evaluation's results.

        Raises EvaluationError where the folder holds other ones, and where a metric's package is not installed.
        """
        if not self.protocol.locating:
            self.judging.prepare()
        identity = {
            "version": version("avmsf"),
            "source": source_digest("avmsf.cli.evaluate"),
            "protocol": self.protocol.name,
            "choosing": repr(self.protocol.choosing),
            "dataset": self.title,
            "seed": self.seed,
            "time_zero": self.time_zero,
            "metrics": _plain(self.judging),
            "modes": _plain(self.finder),
            "settings": dict(self.settings),
        }
        results.begin(identity, {method.name: self._described(method) for method in self.methods}, self.options)

    def _described(self, method: Method) -> str:
        """Return what tells a method apart from another of its name. Methods that read no features share any folder."""
        read = self.encoder is not None and isinstance(method, Looking) and method.look != "surface"
        return f"{method!r}{ENCODER}{self.encoder}" if read else repr(method)


def _plain(settings: Any) -> Any:
    """Return settings as plain values, those of a dataclass by their names, with the name of its class as `kind`."""
    if not is_dataclass(settings):
        return settings
    values = {each.name: _plain(getattr(settings, each.name)) for each in fields(settings)}
    return {"kind": type(settings).__name__, **values}
