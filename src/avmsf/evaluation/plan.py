"""An evaluation: a dataset, a protocol, methods, and the settings that their results depend on."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from avmsf._utils.caching import source_digest
from avmsf._utils.device import TRAINABLE, usable_device
from avmsf.datasets import CaptureCollection
from avmsf.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.editing import Edits
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.published import PUBLISHED
from avmsf.evaluation.registry import METRICS, EvaluationSettings, MetricSettings, Protocol, VisualInput
from avmsf.evaluation.results import SPACES, ResultsFolder, write_json
from avmsf.evaluation.scores import shared_cdpam
from avmsf.evaluation.task import Method
from avmsf.features.encoder import ImageDescriptors
from avmsf.modal.extraction.extract import FINDERS
from avmsf.modal.extraction.finders import HighResolution, ModeFinder
from avmsf.pipeline.config import AUTO, DESCRIPTORS, DINO, PRESETS, LiftConfig, SceneConfig, TimeZero, ViewsConfig
from avmsf.pipeline.features import choose_encoder


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Data set, protocol, methods and settings of an evaluation."""

    title: str
    """Name of the dataset in reports; one folder of results has one."""
    protocol: Protocol
    methods: tuple[Method, ...]
    inputs: ObjectInputs
    """Data set, seed and device of the methods, and what they read of the objects."""
    metric_settings: MetricSettings = field(default_factory=MetricSettings)
    finder: ModeFinder = field(default_factory=HighResolution)
    """Extraction of modes, once per case."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of what methods share (`EvaluationSettings`), as plain values."""
    encoder: str | None = None
    """Encoder that `auto` in the settings stands for; None where the settings name it, or no method reads features."""
    time_zero: str | None = None
    """Start of the dataset's sounds, `onset` or `peak`, on which all methods are scored; None for the dataset's own."""
    own_starts: Dataset | None = None
    """The same dataset with its own starts, for fields that are not of the paper's configuration; None where all
    methods are fitted to the sounds that they are scored on."""
    edits: Edits | None = None
    """What the protocol `edit` needs besides; None with all others."""

    def begin(self, results: ResultsFolder) -> None:
        """Take a folder for this evaluation's results.

        Raises EvaluationError where the folder holds other ones, and where a metric's package is not installed.
        """
        if self.protocol.scoring == "sounds" and self.metric_settings.cdpam:
            shared_cdpam()
        # Edits are scored in an embedding of all of them.
        among, read = {} if self.edits is None else self.edits.materials, self.inputs.dataset.capture
        identity = {
            "version": version("avmsf"),
            "source": source_digest(f"{__package__}.runner"),
            "protocol": self.protocol.name,
            "choosing": {"cases": self.protocol.cases, **self.protocol.settings},
            "dataset": self.title,
            "seed": self.inputs.seed,
            "time_zero": self.time_zero,
            "metrics": _plain(self.metric_settings),
            "columns": sorted(METRICS),
            "modes": _plain(self.finder),
            "settings": dict(self.settings),
            "among": {name: f"{material} {read(name).impacts.digest()}" for name, material in among.items()},
        }
        results.begin(identity, {method.name: self._described(method) for method in self.methods})
        if self.edits is not None:
            write_json(results.path / SPACES, {name: space.record() for name, space in self.edits.spaces.items()})

    def _described(self, method: Method) -> dict[str, str | None]:
        """Return what tells a method apart from another of its name. Methods that read no features share any folder."""
        read = input_of(method if self.edits is None else self.edits.field_method)
        return {"settings": repr(method), "encoder": None if read.form == "surface" else self.encoder}


def _plain(settings: Any) -> dict[str, Any]:
    """Return the values of a dataclass, with the name of its class as `kind`."""
    return {"kind": type(settings).__name__, **asdict(settings)}


def plan_evaluation(
    dataset: Dataset,
    title: str,
    protocol: Protocol,
    methods: tuple[Method, ...],
    *,
    settings: EvaluationSettings,
    views: ViewsConfig,
    cache: Path,
    metrics: MetricSettings,
    seed: int,
    device: str | None,
    time_zero: TimeZero | None,
    log: Callable[[str], None],
) -> Evaluation:
    """Return an evaluation that makes the objects' features, bodies and Gaussians in folders beneath `cache`.

    `log` receives which encoder stands for another. Raises SceneError for an encoder, and EvaluationError for a device,
    that is not available.
    """
    if device is not None:
        usable_device(device, raising=EvaluationError, kinds=TRAINABLE)
    finder, edits, edit = FINDERS[settings.extraction](modes=settings.modes), None, {}
    if protocol.scoring == "edits":
        edits, edit = Edits(dataset, settings.edit, finder, cache, seed), {"edit": asdict(settings.edit)}
        # Where a model cannot be loaded nothing else is worth its time. Workers load their own.
        _ = replace(edits).model, replace(edits).clap
    read = visual_inputs(methods if edits is None else (edits.field_method,), protocol)
    lift, paper = available_encoders(settings.lift, read, device=device, log=log)
    scene = SceneConfig(views, settings.splat, settings.lift)
    inputs = ObjectInputs(
        dataset, cache, replace(scene, lift=lift), paper, settings.geometry, settings.body, device, seed=seed
    )
    body = asdict(settings.body)
    return Evaluation(
        title,
        protocol,
        methods,
        inputs,
        metrics,
        finder,
        {"scene": asdict(scene), "paper": asdict(paper), "geometry": settings.geometry, "body": body, **edit},
        None if lift == settings.lift else lift.encoder,
        time_zero,
        edits=edits,
    )


def available_encoders(
    lift: LiftConfig, inputs: Collection[VisualInput], *, log: Callable[[str], None], device: str | None = None
) -> tuple[LiftConfig, LiftConfig]:
    """Return the settings of features, and those of the paper's form, with the encoders that `inputs` are made with.

    Where no method reads views no encoder is loaded. `log` receives that another replaces DINOv2. Raises SceneError
    where a method reads the paper's features and their encoder is not available.
    """
    paper = PRESETS["paper"].scene.lift
    if lift.encoder != AUTO:
        return lift, replace(paper, encoder=lift.encoder)
    if any(each.form == "paper" for each in inputs):
        choose_encoder(paper, log=log, device=device)
        return replace(lift, encoder=paper.encoder), paper
    if all(each.form == "surface" for each in inputs):
        return lift, paper
    built_in = isinstance(choose_encoder(lift, log=log, device=device), ImageDescriptors)
    return replace(lift, encoder=DESCRIPTORS if built_in else DINO), paper


def input_of(method: Method) -> VisualInput:
    """Return the features that a method reads; the surface, which needs no encoder, for one that does not say."""
    read: VisualInput = getattr(method, "visual_input", VisualInput())
    return read


def visual_inputs(methods: Sequence[Method], protocol: Protocol) -> frozenset[VisualInput]:
    """Return the features that an evaluation reads: those of its methods, and the points that locate recordings."""
    read = {input_of(method) for method in methods}
    return frozenset(read | {VisualInput()} if protocol.scoring == "contacts" else read)


def dataset_title(dataset: Dataset, folder: Path) -> str:
    """Return a dataset's name in reports: captures by their folder, which identifies them."""
    if not isinstance(dataset, CaptureCollection):
        return dataset.name
    name = folder.resolve().name
    return f"{name} (captures)" if name in {published for published, _ in PUBLISHED} else name
