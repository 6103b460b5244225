"""From a dataset, a protocol and methods to the `Evaluation` that runs them, with the encoders that are available."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf.datasets import CaptureCollection
from avmsf.datasets.dataset import Dataset
from avmsf.errors import EvaluationError
from avmsf.evaluation.case_run import Evaluation
from avmsf.evaluation.config import EvaluationSettings
from avmsf.evaluation.field_methods import FieldMethod
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.published import PUBLISHED
from avmsf.evaluation.registry import Protocol
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.task import Method, VisualInput
from avmsf.features.descriptors import ImageDescriptors
from avmsf.modal.extraction.finders import finder_named
from avmsf.pipeline.config import AUTO, DESCRIPTORS, DINO, PRESETS, LiftConfig, SceneConfig, TimeZero, ViewsConfig
from avmsf.pipeline.features import choose_encoder


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
    lift, paper = available_encoders(settings.lift, visual_inputs(methods, protocol), device=device, log=log)
    scene = SceneConfig(views, settings.splat, settings.lift)
    inputs = ObjectInputs(
        dataset, cache, replace(scene, lift=lift), paper, settings.geometry, settings.body, device, seed=seed
    )
    body = asdict(settings.body)
    return Evaluation(
        dataset,
        title,
        protocol,
        methods,
        inputs,
        seed,
        metrics,
        finder_named(settings.extraction, settings.modes),
        {"scene": asdict(scene), "paper": asdict(paper), "geometry": settings.geometry, "body": body},
        device,
        None if lift == settings.lift else lift.encoder,
        time_zero,
    )


def available_encoders(
    lift: LiftConfig,
    inputs: Collection[VisualInput],
    *,
    log: Callable[[str], None],
    device: str | None = None,
) -> tuple[LiftConfig, LiftConfig]:
    """Return the settings of features, and those of the paper's form, with the encoders that `inputs` are made with.

    Where no method reads views no encoder is loaded. `log` receives that another replaces DINOv2. Raises SceneError
    where a method reads the paper's features and their encoder is not available.
    """
    paper = PRESETS["paper"].scene.lift
    if lift.encoder != AUTO:
        return lift, replace(paper, encoder=lift.encoder)
    if any(visual_input.startswith("paper") for visual_input in inputs):
        choose_encoder(paper, log=log, device=device)
        return replace(lift, encoder=paper.encoder), paper
    if not set(inputs) - {"surface"}:
        return lift, paper
    built_in = isinstance(choose_encoder(lift, log=log, device=device), ImageDescriptors)
    return replace(lift, encoder=DESCRIPTORS if built_in else DINO), paper


def visual_inputs(methods: Sequence[Method], protocol: Protocol) -> frozenset[VisualInput]:
    """Return the features that an evaluation reads: those of its methods, and the points that locate recordings."""
    read = {method.visual_input for method in methods if isinstance(method, FieldMethod)}
    return frozenset(read | {"surface"} if protocol.locating else read)


def dataset_title(dataset: Dataset, folder: Path) -> str:
    """Return a dataset's name in reports: captures by their folder, which identifies them."""
    if not isinstance(dataset, CaptureCollection):
        return dataset.name
    name = folder.resolve().name
    return f"{name} (captures)" if name in {published for published, _ in PUBLISHED} else name
