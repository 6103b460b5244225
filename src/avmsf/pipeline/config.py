"""One configuration for all stages from views and recordings to a field, and the presets.

Importing this imports nothing that computes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal, get_args

from avmsf.errors import FitError, SceneError, SimulationError
from avmsf.field.config import PAPER, FitConfig, GainModelName
from avmsf.gaussians.config import SplatConfig
from avmsf.modal.config import ExtractionMethod

Preset = Literal["default", "paper"]
TimeZero = Literal["onset", "peak"]
Geometry = Literal["mesh", "gaussians"]
DINO = "facebook/dinov2-base"
DESCRIPTORS = "descriptors"
AUTO = "auto"
CACHE = ".avmsf"
"""Folder inside a capture folder that keeps the outputs of the stages."""
CACHED_FIELD, SURFACE = "field.safetensors", "surface.ply"
"""Names of the field and of the object's surface, in meters, in it."""


@dataclass(frozen=True)
class ViewsConfig:
    """How views are made of what a folder holds."""

    source: Literal["best", "mesh"] = "best"
    """Source of the views: the best in the folder, photographs with cameras before a mesh, or the mesh."""
    count: int = 0
    """Views to use at most, of cameras far apart; 0 uses all."""
    longest: int = 640
    """Pixels of a photograph's longer side; larger ones are scaled down."""
    masks: bool = True
    """Find the object in photographs without masks, which needs a plain background."""
    frames: int = 72
    """Frames to pick from a video."""
    rendered: int = 256
    """Pixels along each side of the 72 images that are rendered of a mesh."""
    minutes: float = 30.0
    """Time that structure from motion may take."""
    seed: int = 0
    """Seed of structure from motion."""

    def __post_init__(self) -> None:
        if self.count < 0:
            raise SceneError.expected("0 for all views, or how many to use", self.count, name="count")


@dataclass(frozen=True)
class LiftConfig:
    """Settings of the features."""

    encoder: str = AUTO
    """What describes the images: the name of a DINOv2 model (such as facebook/dinov2-base), a folder that holds one,
    `efficientnet-lite0` (extra `efficientnet`, no download), `descriptors` (built in), or `auto`: DINOv2 base if it is
    available, else the built-in ones."""
    longest: int = 518
    """Pixels of the longer side of a network's input images."""
    encoder_background: Literal["inpainted", "kept"] = "inpainted"
    """Encoder input outside an object's mask: colors of the object continued, or the image unchanged (paper)."""
    weighting: Literal["plain", "visibility"] = "visibility"
    """Average over the views that see a point: weighted by visibility, or plain (paper)."""
    components: int = 32
    """Principal components of the features to use; 0 uses the features unchanged, at the encoder's own scale."""
    standardize: bool = False
    """Without components, subtract the features' mean over the points and scale them to a mean square length of 1,
    before they are pooled over symmetries."""
    symmetry: bool = True
    """Average the features over the symmetries of the object's shape."""
    iterations: int = 3
    """How often features are pooled over the symmetries (paper: T)."""
    angles: int = 36
    """Angles by which a continuous rotation is sampled (paper: the size of Theta)."""
    reach: float = 3.0
    """Point spacings within which the nearest point is a symmetric counterpart; 0 takes it at any distance (paper)."""
    positions: bool = True
    """Begin the features with the points' positions relative to the object's size."""
    onto: Literal["mesh", "gaussians"] = "mesh"
    """Points of the features for a folder with a mesh only: on its surface, or Gaussians fitted to images of it."""
    points: int = 8192
    """Points on the surface of a mesh."""
    seed: int = 0
    """Seed of the random choices: points of a mesh, and those of them that the search for symmetries uses."""

    def __post_init__(self) -> None:
        lowest = {"longest": 1, "components": 0, "iterations": 1, "angles": 2, "points": 100, "seed": 0}
        for name, least in lowest.items():
            if getattr(self, name) < least:
                raise SceneError.expected(f"{least} or more", getattr(self, name), name=name)
        if self.seed >= 2**63:
            raise SceneError.expected("less than 2^63", self.seed, name="seed")
        if not 0 <= self.reach < math.inf:
            raise SceneError.expected("a number of point spacings, or 0 for any distance", self.reach, name="reach")
        if self.standardize and self.components:
            advice = "set components to 0, or leave standardize out"
            raise SceneError.expected("no components", self.components, name="standardize", advice=advice)


@dataclass(frozen=True)
class BodyConfig:
    """How finite-element models are made of an object's shape."""

    wall: float | None = None
    """Wall thickness of the object, meters; 0 for a solid body. By default several are tried, and the recordings
    decide."""
    shapes: int = 80
    """Number of the lowest elastic mode shapes for the gains and for updating stiffness and density."""
    dofs: int = 40_000
    """Approximate degrees of freedom of the finite elements."""
    supports: Literal["auto", "free", "try"] = "auto"
    """Whether the object may have been held at its lowest part (z is upwards) or its ends. auto: tried if the free body
    predicts little better than none by leave-one-out. free: it lay on foam or hung. try: always tried, which takes 10
    to 60 s more."""

    def __post_init__(self) -> None:
        if self.wall is not None and not 0 <= self.wall < float("inf"):
            raise SimulationError.expected("meters, or 0 for a solid body", self.wall, name="wall")
        if self.shapes < 1:
            raise SimulationError.expected("1 or more", self.shapes, name="shapes")


@dataclass(frozen=True)
class SceneConfig:
    """Settings of all stages up to the features."""

    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made of what the folder holds."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted to views."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made of views and Gaussians."""

    def with_seed(self, seed: int) -> "SceneConfig":
        """Return the settings with one seed for all stages."""
        parts = {each.name: replace(getattr(self, each.name), seed=seed) for each in fields(self)}
        return replace(self, **parts)


@dataclass(frozen=True)
class PipelineConfig:
    """Settings of all stages."""

    gain_model: GainModelName = "auto"
    """How gains vary over the object."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """How finite-element models are made of the object's shape."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """How views, Gaussians and features are made."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How the field is fitted."""
    extraction: ExtractionMethod = "high-resolution"
    """How modes are found."""
    modes: int = 128
    """Modes to use at most."""
    time_zero: TimeZero | None = None
    """Where sounds start; None takes the capture's settings."""
    device: str | None = None
    """cpu or cuda; None takes the GPU where there is one. Features and training give the same result up to rounding,
    Gaussians differ; cached stages are used for either device."""
    allow_missing_features: bool = True
    """Let the network read positions alone where nothing shows the object's appearance (the paper's "w/o visual")."""

    def __post_init__(self) -> None:
        """Raise FitError for the name of no gain model or extraction method, and for no modes."""
        for name, known in (("gain_model", GainModelName), ("extraction", ExtractionMethod)):
            value = getattr(self, name)
            if value not in get_args(known):
                raise FitError.expected(f"one of {', '.join(get_args(known))}", value, name=name)
        if self.time_zero not in (None, *get_args(TimeZero)):
            raise FitError.expected(f"None or one of {', '.join(get_args(TimeZero))}", self.time_zero, name="time_zero")
        if not isinstance(self.modes, int) or self.modes < 1:
            raise FitError.expected("a whole number of 1 or more", self.modes, name="modes")


PRESETS: Mapping[Preset, PipelineConfig] = {
    "default": PipelineConfig(),
    "paper": PipelineConfig(
        gain_model="network",
        scene=SceneConfig(
            lift=LiftConfig(
                encoder=DINO,
                encoder_background="kept",
                weighting="plain",
                components=0,
                reach=0.0,
                positions=False,
                onto="gaussians",
            )
        ),
        fit=PAPER,
        extraction="short-time",
        time_zero="peak",
        allow_missing_features=False,
    ),
}
"""`paper` has every stage as published, and of each published list the middle value; docs/paper-map.md lists what the
paper leaves open."""
