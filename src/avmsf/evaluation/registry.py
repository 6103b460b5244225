"""What an evaluation is chosen from: tables of methods, protocols and metrics, and settings that methods share.

A row has a title and the import path of what makes it, and is all that a new method or metric needs besides its
function. Importing this module loads nothing that computes.
"""

import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from avmsf.editing.config import GuidedEditConfig
from avmsf.errors import EvaluationError
from avmsf.gaussians.config import SplatConfig
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import BodyConfig, Geometry, LiftConfig

if TYPE_CHECKING:
    from avmsf.capture.impacts import Impacts
    from avmsf.evaluation.splits import Case

BASELINE = "knn3"
"""The method that all others are compared with."""


def resolve(path: str | Callable[..., Any]) -> Callable[..., Any]:
    """Return the function or class at an import path below this package, such as `metrics:envelope_distance`."""
    found: Callable[..., Any] = pkgutil.resolve_name(f"{__package__}.{path}") if isinstance(path, str) else path
    return found


@dataclass(frozen=True)
class MetricEntry:
    """One metric."""

    heading: str
    """Heading of its column; empty for one that `summary.json` alone has."""
    function: str | Callable[..., Any] | None = None
    """Function (predicted, truth, *, sample_rate) of sounds [contacts, samples] in one unit that returns a value for
    each contact, or its import path; None for what is computed of something else than these."""
    rising: bool = False
    """Whether more is better; only metrics of which less is better have ratios."""


METRICS: dict[str, MetricEntry] = {
    "l1": MetricEntry("L1", "metrics:spectrogram_distance"),
    "l1_log": MetricEntry("L1-log", "metrics:log_mel_distance"),
    "envelope": MetricEntry("ENV", "metrics:envelope_distance"),
    "cdpam": MetricEntry("CDPAM"),
    "relative_stft": MetricEntry("relative STFT", "metrics:relative_stft_error"),
    "mac": MetricEntry("MAC", rising=True),
    "gain_error": MetricEntry("gain error"),
    "rmed": MetricEntry("RMED"),
    "rmed_posterior": MetricEntry("RMED, posterior"),
    "found": MetricEntry("", rising=True),
    "umap": MetricEntry("UMAP"),
    "umap_dampings": MetricEntry("UMAP with dampings"),
    "spectral": MetricEntry("spectral distance"),
    "clap": MetricEntry("CLAP", rising=True),
}
"""All metrics that tables show or of which more is better, by name, in the order of columns."""


@dataclass(frozen=True)
class VisualInput:
    """Which features of an object's points a method reads."""

    form: Literal["surface", "visual", "paper"] = "surface"
    """`surface`: positions of points on the mesh, of an object without one of the points that views show. `visual`:
    positions with features of views. `paper`: the paper's features of Gaussians, without positions."""
    bare: bool = False
    """Whether only the positions of these points are read."""
    pooled: bool = True
    """Whether features are pooled over the object's symmetries."""
    standardized: bool = False
    """Whether features have mean 0 and length 1 before pooling."""


@dataclass(frozen=True)
class MethodEntry:
    """One method."""

    title: str
    """What reports call it."""
    fit: str | Callable[..., Any] = ""
    """Function (task, **settings) that returns a renderer, or its import path; empty for a method with `make`."""
    make: str = ""
    """Import path of what makes the method of its name and `settings`, where it is more than a function."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    visual_input: VisualInput = VisualInput()
    """The features that a function with `fit` reads, by the field that it asks for."""
    path: str = ""
    """The folder or file that it reads, as the setting `path`, for a method whose name goes on with `:` and a path."""
    is_folder: bool = False
    """Whether that is a folder."""
    is_edit: bool = False
    """Whether it edits sounds, of the protocol `edit` alone; its function gets an `editing.EditTask`."""


def _made(make: str, **common: Any) -> Callable[..., MethodEntry]:
    return lambda title, **settings: MethodEntry(title, make=make, settings={**common, **settings})


_process, _network = (_made("methods:field_method", visual_input=VisualInput(each)) for each in ("surface", "visual"))
_paper = _made("methods:field_method", visual_input=VisualInput("paper"), published=True)
_edit = partial(MethodEntry, is_edit=True)


def _guided(title: str, parameters: str) -> MethodEntry:
    return _edit(title, "editing:guided", settings={"parameters": parameters})


METHODS: dict[str, MethodEntry] = {
    "white-noise": MethodEntry(
        "Gaussian noise at the level of the training recordings", "simple_methods:WhiteNoise.of"
    ),
    "random-impact": MethodEntry("a recording of another object", "simple_methods:RandomImpact.of"),
    "nearest": MethodEntry("the nearest training recording", "simple_methods:NearestRecording.of"),
    "knn3": MethodEntry(
        "mean waveform of the three nearest recordings (the paper's KNN)", "simple_methods:MeanWaveform.of"
    ),
    "knn3-directions": MethodEntry(
        "mean waveform of the three nearest recordings, by position and impact direction",
        "simple_methods:MeanWaveform.of",
        settings={"by_direction": True},
    ),
    "knn-gains": MethodEntry("modal gains averaged over the three nearest recordings", "simple_methods:MeanGains.of"),
    "spline-gains": MethodEntry("modal gains by thin-plate splines", "simple_methods:SplineGains.of"),
    "diffsound": MethodEntry("reimplementation of DiffSound with a measured residual", "methods:diffsound"),
    "paper-diffsound": MethodEntry(
        "reimplementation of DiffSound with the residual that `paper` learns, as in the paper",
        "methods:diffsound",
        settings={"learned_residual": True},
        visual_input=VisualInput("paper"),
    ),
    "diffsound-weighted": MethodEntry(
        "DiffSound with a fitted weight for each mode", "methods:diffsound", settings={"weighted": True}
    ),
    "field": _network("attention network, quick settings, visual features"),
    "field-auto": _process("Gaussian process over kernel families (the default of this package)", model="auto"),
    "field-elastic": _process("Gaussian process on elastic mode shapes only", model="elastic"),
    "field-smooth": _process("Gaussian process on distances only", model="smooth"),
    "field-thin-plate": _process("Gaussian process of thin-plate splines only", model="thin-plate"),
    "field-positions": _network(
        "attention network, quick settings, positions only", visual_input=VisualInput("visual", bare=True)
    ),
    "field-unaligned": _network(
        "attention network, quick settings, without symmetry pooling", visual_input=VisualInput("visual", pooled=False)
    ),
    # All steps end to end take long enough without two trials of dampings beforehand. The noise is trained, as
    # measuring it needs the modes.
    "field-no-initialization": _network(
        "attention network, quick settings, without extracted modes", informed=False, damping="shared", noise_rate=0.1
    ),
    "field-no-residual": _network("attention network, quick settings, without residual noise", residual=False),
    # The warm-up moves no damping, so there is nothing to choose between.
    "field-warmup": _network("attention network, quick settings, warm-up only", steps=0, damping="shared"),
    "av-msf": _paper(
        "AV-MSF, the preset `paper`: the paper's method with the damping, shared or per contact, of lower ENV at "
        "held-out training contacts",
        damping="validated",
    ),
    "paper": _paper("the paper's method with the preset `paper`, shared damping"),
    "paper-positions": _paper(
        "the paper's method without visual features", visual_input=VisualInput("paper", bare=True)
    ),
    "paper-no-initialization": _paper("the paper's method without extracted modes", informed=False),
    "paper-unaligned": _paper(
        "the paper's method without symmetry pooling", visual_input=VisualInput("paper", pooled=False)
    ),
    "paper-no-residual": _paper("the paper's method without residual noise", residual=False),
    "paper-per-contact": _paper("the paper's method with damping per contact", damping="per-contact"),
    "paper-regularized": _paper(
        "the paper's method with positive gains, standardized features and weight decay",
        visual_input=VisualInput("paper", standardized=True),
        positive_gains=True,
        weight_decay=1.0,
    ),
    "paper-mean-gains": MethodEntry(
        "the modes and noise of `paper`, with its own gains averaged over the three nearest training contacts",
        "methods:mean_trained_gains",
        visual_input=VisualInput("paper"),
    ),
    "field-grid": _network("attention network, settings chosen from a small grid", grid=True),
    "paper-grid": _paper("the paper's method with settings chosen from its lists", grid=True),
    "sonicgauss": MethodEntry(
        "SonicGauss with its published weights, trained on ObjectFolder Real, fine-tuned",
        "methods:sonicgauss",
        path="a folder with the published weights",
        is_folder=True,
    ),
    "recorded": MethodEntry(
        "sounds of another system, from files",
        make="methods:RecordedMethod",
        path="a folder with a folder of wav files for every object",
        is_folder=True,
    ),
    "unedited": _edit("the field before the edit", "editing:unedited"),
    "generation": _edit("a sound that the model generates from the prompt alone", "editing:generation"),
    "edit-independent": _guided("guided edit of every mode by itself (Audio-SDS)", "independent"),
    "edit-published": _guided("guided edit with the paper's parameters", "published"),
    "edit-hierarchical": _guided("guided edit with this package's parameters", "hierarchical"),
    "edit-searched": _guided("guided edit of every mode by itself, after a search", "searched"),
    "edit-physics": _edit("the laws of elasticity with both materials' constants", "editing:physics"),
}
"""All methods by name, in the order of tables."""
_TABLE = (
    *("white-noise", "random-impact", "nearest", BASELINE, "knn3-directions", "knn-gains", "spline-gains"),
    *("field", "field-elastic", "field-auto"),
)
_ABLATED = ("field-positions", "field-no-initialization", "field-unaligned", "field-no-residual")


@dataclass(frozen=True)
class Protocol:
    """One experiment of the paper: how contacts are split, and which methods and objects take part."""

    name: str
    """What the command line calls it."""
    title: str
    """What it does, in a sentence."""
    cases: str = "splits:farthest"
    """Import path of the function (impacts, **settings) that splits an object's contacts."""
    methods: tuple[str, ...] = _TABLE
    """Names of the methods that take part unless others are asked for; the baseline is among them."""
    subset: Literal["ablation", "non-symmetric"] | None = None
    """The objects that take part unless others are asked for; None for all. All objects of a dataset stand for those of
    the ablation where it has none of them."""
    scoring: Literal["sounds", "contacts", "edits"] = "sounds"
    """What methods are evaluated by: the sounds of the test recordings, their contacts as located, or edited sounds."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the function `cases`."""

    def split(self, impacts: "Impacts") -> "tuple[Case, ...]":
        """Return the cases of an object. Raises EvaluationError for too few contacts."""
        found: tuple[Case, ...] = resolve(self.cases)(impacts, **self.settings)
        return found


PROTOCOLS: dict[str, Protocol] = {
    each.name: each
    for each in (
        Protocol("farthest", "Train on 20 % of the contacts, chosen by farthest-point sampling; test on the others."),
        Protocol("leave-one-out", "Test on every contact once, after training on all others.", "splits:leave_one_out"),
        Protocol(
            "closest",
            "Train on 20 % of the contacts, in one region; test on the others.",
            "splits:closest",
            subset="ablation",
        ),
        Protocol(
            "predefined",
            "Test on the recordings that are named; train on those at other contacts.",
            "splits:predefined",
        ),
        Protocol(
            "shots",
            "Train on nested subsets of contacts by farthest-point sampling; test on those left by the largest.",
            "splits:shots",
            subset="ablation",
        ),
        Protocol(
            "views",
            "Visual features from all views and from 12; train and test as in `farthest`.",
            "splits:fewer_views",
            (BASELINE, "field"),
            subset="ablation",
        ),
        Protocol(
            "ablation",
            "Ablations of one part each: visual features, initialization, symmetry pooling, residual noise.",
            methods=(BASELINE, "field", *_ABLATED),
            subset="ablation",
        ),
        Protocol("non-symmetric", "As `farthest`, on objects without rotational symmetry.", subset="non-symmetric"),
        Protocol(
            "localize",
            "Train as in `farthest`; locate the test recordings, on objects without rotational symmetry.",
            methods=("white-noise", "nearest", "diffsound", "field", "field-no-residual", "field-auto"),
            subset="non-symmetric",
            scoring="contacts",
        ),
        Protocol(
            "grid",
            "Choose the field's settings from a small grid on validation contacts (the paper's: `paper-grid`); "
            "test as in `farthest`.",
            methods=(BASELINE, "field", "field-grid"),
            subset="ablation",
        ),
        Protocol(
            "edit",
            "Change the material of objects, towards prompts or recordings; distance of edited modes and sounds from "
            "objects of the new material. Takes six objects or more, of two known materials or more.",
            "splits:edited",
            ("unedited", "edit-independent", "edit-hierarchical"),
            scoring="edits",
        ),
    )
}
"""All experiments by name."""


def protocol_named(name: str) -> Protocol:
    """Return the protocol of this name. Raises EvaluationError that lists the known ones."""
    if name not in PROTOCOLS:
        raise EvaluationError.unknown(name, PROTOCOLS, name="protocol")
    return PROTOCOLS[name]


def method_entry(name: str) -> MethodEntry:
    """Return the row of a method, with or without its path. Raises EvaluationError that lists the known ones."""
    kind = kind_of(name)
    if kind not in METHODS or (kind != name and not METHODS[kind].path):
        known = [f"{each}:PATH" if row.path else each for each, row in METHODS.items()]
        raise EvaluationError.unknown(name, known, name="method")
    return METHODS[kind]


def suited_methods(protocol: str) -> list[str]:
    """Return the names of the methods that edit sounds, or of those that predict them, as the protocol asks."""
    edits = PROTOCOLS[protocol].scoring == "edits"
    return [name for name, row in METHODS.items() if row.is_edit == edits]


def expect_suited(method: str, protocol: str) -> None:
    """Raise `EvaluationError` for a method whose sounds cannot be those of the protocol's training recordings."""
    edits = PROTOCOLS[protocol].scoring == "edits"
    if method_entry(method).is_edit != edits:
        wanted = f"a method that {'edits' if edits else 'predicts'} sounds, such as {PROTOCOLS[protocol].methods[0]}"
        raise EvaluationError.expected(f"{wanted}, for {protocol}", method, name="method")
    if kind_of(method) == "recorded" and protocol == "shots":
        wanted, advice = f"a protocol that tests each recording once for {method}", "choose another, such as farthest"
        got = f"{protocol}, which trains on several sets of recordings, and the folder holds the sounds of one"
        raise EvaluationError.expected(wanted, method, got=got, name="method", advice=advice)


def kind_of(method: str) -> str:
    """Return a method's name without the file or folder that it reads."""
    return method.partition(":")[0]


@dataclass(frozen=True)
class EditProtocolSettings:
    """Settings of the protocol `edit`."""

    fields: str = "field-auto"
    """The method that fits the fields that are edited; `paper` is the paper's."""
    model: str | None = None
    """Stable Audio, a folder or a name on the hub, to edit towards prompts; by default edits are towards recordings of
    another object of the new material, and need no weights."""
    model_seconds: float | None = None
    """Length that the model works at; by default all that it was trained for."""
    generated: float = 3.0
    """Seconds of the sounds of the method `generation`."""
    clap: str | None = None
    """CLAP, likewise, for the CLAP score of edits towards prompts; needs the extra `eval`."""
    guide: GuidedEditConfig = field(default_factory=GuidedEditConfig)
    """How the modes are optimized; the seed is that of the evaluation."""

    def __post_init__(self) -> None:
        if self.clap is not None and self.model is None:
            raise EvaluationError.expected("edit.model with it, for there are no prompts without", name="edit.clap")


@dataclass(frozen=True)
class EvaluationSettings:
    """What methods share."""

    geometry: Geometry = "mesh"
    """Shape that finite elements use: the object's mesh, or the surface of Gaussians fitted to its views."""
    extraction: ExtractionMethod = "high-resolution"
    """How the modes that methods share are extracted; see `avmsf modes --help`. The methods `paper` have their own."""
    modes: int = 128
    """Maximum number of the modes that methods share."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made. The methods `paper` use the paper's own settings and only the encoder given here: DINOv2
    without `lift.encoder`, which then has to be installed."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Elastic bodies."""
    edit: EditProtocolSettings = field(default_factory=EditProtocolSettings)
    """The protocol `edit`."""


@dataclass(frozen=True)
class MetricSettings:
    """Which metrics are computed."""

    cdpam: bool = True
    """Whether to compute CDPAM, the slowest metric."""
    cdpam_contacts: int = 8
    """Number of test contacts per case, evenly spaced, at which CDPAM is computed; 0 for all."""

    def __post_init__(self) -> None:
        if self.cdpam_contacts < 0:
            raise EvaluationError.expected("0 (all) or more", self.cdpam_contacts, name="cdpam_contacts")
